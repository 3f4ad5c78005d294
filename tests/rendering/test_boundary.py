"""The smooth boundary against Mitsuba's dielectric, whose events it has bit for bit, and what stands in its place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rendered import independent

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

from benchmarks.mitsuba_media import with_media  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.surface.translucent import is_smooth_boundary, smooth_boundary  # noqa: E402
from full_geometry.trade.techniques import techniques  # noqa: E402

N, BOTH = 4000, 0xFFFFFFFF


@pytest.fixture(autouse=True)
def rendering() -> None:
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


def dielectric(eta: float, **more: Any) -> dict[str, Any]:
    return {"type": "dielectric", "int_ior": eta, "ext_ior": 1.0, **more}


def seen(rng: np.random.Generator) -> Any:
    """From both sides, and along the surface."""
    w = rng.normal(size=(3, N))
    w[2, :4] = 0
    si = dr.zeros(mi.SurfaceInteraction3f, N)
    si.wi = dr.normalize(mi.Vector3f(w))
    return si


@pytest.mark.parametrize("eta", [1.5, 1.33, 1.0, 0.7])
@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("component", [0, 1, BOTH])
def test_events_weights_and_densities_are_those_of_mitsuba(eta: float, mode: str, component: int) -> None:
    theirs, ours = mi.load_dict(dielectric(eta)), smooth_boundary(eta)
    assert ours.flags() == theirs.flags()
    assert [ours.flags(k) for k in (0, 1)] == [theirs.flags(k) for k in (0, 1)]
    ctx = mi.BSDFContext(getattr(mi.TransportMode, mode))
    ctx.component = component
    rng = np.random.default_rng(3)
    si, u = seen(rng), mi.Float(rng.random(N))
    (bs, weight), (bs_theirs, expected) = (surface.sample(ctx, si, u, mi.Point2f(0.5)) for surface in (ours, theirs))
    assert np.all(np.array(weight) == np.array(expected))
    for name in ("wo", "pdf", "eta", "sampled_type", "sampled_component"):
        assert np.all(np.array(getattr(bs, name)) == np.array(getattr(bs_theirs, name))), name


def test_a_ray_that_is_not_active_has_no_weight() -> None:
    si = seen(np.random.default_rng(3))
    weight = smooth_boundary(1.4).sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(0.5), mi.Bool(False))[1]
    assert not np.array(weight).any()


def surface(**inside: Any) -> Any:
    return mi.load_dict({"type": "translucent", "sigma_s": 1.0, "sigma_a": 0.5, "eta": 1.4, **inside})


def test_a_plain_dielectric_is_taken_as_its_index_and_a_tinted_or_rough_one_as_it_is() -> None:
    tint = {"specular_reflectance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}}
    rough = {**dielectric(1.4), "type": "roughdielectric", "alpha": 0.1}
    assert is_smooth_boundary(surface().boundary) and is_smooth_boundary(surface(inner=dielectric(1.4)).boundary)
    assert surface(inner=dielectric(1.4, **tint)).boundary.class_name() == "SmoothDielectric"
    assert surface(inner=rough).boundary.class_name() == "RoughDielectric"


OTHERS = {
    "thindielectric": {"int_ior": 1.4, "ext_ior": 1.0},
    "plastic": {"int_ior": 1.4, "ext_ior": 1.0},
    "roughplastic": {"int_ior": 1.4, "ext_ior": 1.0},
    "principled": {"eta": 1.4, "spec_trans": 1.0},
    "principledthin": {"eta": 1.4},
    "conductor": {},
    "null": {},
    "mask": {"opacity": 0.5, "inner": dielectric(1.4)},
    "bumpmap": {"map": {"type": "checkerboard"}, "inner": dielectric(1.4)},
}


@pytest.mark.parametrize("kind", OTHERS)
def test_boundaries_of_other_kinds_are_refused_by_name(kind: str) -> None:
    with pytest.raises(Exception, match=r"the boundary must be a dielectric or roughdielectric, got a \w+"):
        surface(inner={"type": kind, **OTHERS[kind]})


UNKNOWN_TO_MODELS = {
    "without specular_reflectance": dielectric(1.4, specular_reflectance=0.5),
    "without specular_transmittance": dielectric(1.4, specular_transmittance=0.5),
    "smooth": {**dielectric(1.4), "type": "roughdielectric", "alpha": 0.1},
}


@pytest.mark.parametrize("wanted", UNKNOWN_TO_MODELS)
def test_a_tinted_or_rough_boundary_is_refused_by_every_way_but_walks_and_what_they_correct(wanted: str) -> None:
    inner = UNKNOWN_TO_MODELS[wanted]
    bsdf = {"type": "translucent", "sigma_s": 1.0, "sigma_a": 0.5, "eta": 1.4, "inner": inner}
    described = {
        "type": "scene",
        "ball": {"type": "sphere", "radius": 3.0, "bsdf": bsdf},
        "light": {"type": "constant"},
    }
    loaded = mi.load_dict(described)
    asked = [{"model": way.model, "light": way.light} for way in techniques() if not way.walks]
    corrected = [each for each in asked if each["light"] == "corrected"]
    asked = [each for each in asked if each not in corrected]
    asked += [{"model": "auto"}, {"light": "auto"}, *({"orders": orders} for orders in ("single", "multiple"))]
    preparations = [mi.load_dict({"type": "bssrdf", **each}).prepare for each in asked]
    for ask in (*preparations, lambda scene: object_of(scene, None, 1.0)):
        with pytest.raises(ValueError, match=f"boundary of object 'ball' must be {wanted} under a model, got a .*walk"):
            ask(loaded)
    for each in corrected:
        mi.load_dict({"type": "bssrdf", **each}).check(loaded)
    mi.load_dict({"type": "translucent_walk"}).tracer(loaded)


def test_volume_paths_meet_the_dielectric_of_mitsuba() -> None:
    ball = {"type": "sphere", "bsdf": {"type": "translucent", "sigma_s": 1.0, "sigma_a": 0.5, "eta": 1.4}}
    found = with_media({"type": "scene", "ball": ball, "light": {"type": "constant"}}, 1.0)
    boundary = found.shapes()[0].bsdf()
    assert boundary.class_name() == "SmoothDielectric" and mi.traverse(boundary)["eta"] == pytest.approx(1.4)


def test_a_rough_boundary_loses_in_a_white_furnace_what_that_of_mitsuba_loses() -> None:
    rough = {**dielectric(1.4), "type": "roughdielectric", "alpha": 0.5}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0])
    scene = {
        "type": "scene", "integrator": {"type": "translucent_walk"}, "sky": {"type": "constant"},
        "ball": {"type": "sphere", "radius": 2.0,
                 "bsdf": {"type": "translucent", "albedo": 1.0, "sigma_t": 1.0, "eta": 1.4, "inner": rough}},
        "sensor": {"type": "perspective", "fov": 2.5, "to_world": at, "film": film},
    }  # fmt: skip
    theirs = with_media(scene, 1.0, {"type": "volpathmis", "max_depth": -1, "rr_depth": 10000})
    images = [independent(s, 8, 64).mean(axis=(1, 2, 3)) for s in (mi.load_dict(scene), theirs)]
    (ours, own), (other, error) = ((np.mean(v), np.std(v, ddof=1) / 8**0.5) for v in images)
    assert abs(ours - other) < 4 * np.hypot(own, error) and max(own, error) < 0.003
    assert ours < 0.9


@pytest.mark.slow
@pytest.mark.parametrize("light", ["sampled", "precomputed"])
def test_colours_of_a_boundary_are_in_the_light_of_a_lamp_as_in_that_of_mitsuba(light: str, volume_image: Any) -> None:
    scene = mi.load_dict({**_tinted(), "integrator": {"type": "translucent_walk", "light": light}})
    found = np.mean([np.array(mi.render(scene, spp=1024, seed=seed)).mean(axis=(0, 1)) for seed in (1, 2)], axis=0)
    np.testing.assert_allclose(found, volume_image, rtol=0.04)


def _tinted(**more: Any) -> dict[str, Any]:
    """A ball whose boundary reflects blue and lets red through, and a lamp that looks small from it."""
    tints = {"specular_reflectance": [0.0, 0.5, 1.0], "specular_transmittance": [1.0, 0.9, 0.6]}
    boundary = dielectric(1.6, **{key: {"type": "rgb", "value": value} for key, value in tints.items()})
    ball = {"bsdf": {"type": "translucent", "sigma_t": 7.0, "albedo": 0.95, "eta": 1.6, "boundary": boundary}}
    if more:
        ball = {"bsdf": boundary, **more}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([4, 2, 6], [0, 0, 0], [0, 1, 0])
    lamp = {"type": "sphere", "center": [3, 5, 4], "radius": 1.2, "emitter": {"type": "area", "radiance": 10.0}}
    sensor = {"type": "perspective", "fov": 20.0, "to_world": view, "film": film}
    return {"type": "scene", "ball": {"type": "sphere", **ball}, "lamp": lamp, "sensor": sensor}


@pytest.fixture(scope="module")
def volume_image() -> np.ndarray:
    """The mean of an image by `volpathmis`, with a standard error of 1.1 %."""
    mi.set_variant("llvm_ad_rgb")
    medium = {"type": "homogeneous", "sigma_t": 7.0, "albedo": 0.95, "phase": {"type": "isotropic"}}
    scene = mi.load_dict({**_tinted(interior=medium), "integrator": {"type": "volpathmis", "max_depth": -1}})
    return np.mean([np.array(mi.render(scene, spp=2048, seed=seed)).mean(axis=(0, 1)) for seed in range(6)], axis=0)


@pytest.mark.parametrize("boundary", [None, {"type": "roughdielectric", "int_ior": 1.4, "ext_ior": 1.0, "alpha": 0.2}])
def test_an_index_that_is_refused_leaves_the_boundary_of_the_medium(boundary: dict[str, Any] | None) -> None:
    bsdf = {
        "type": "translucent",
        "sigma_t": 5.0,
        "albedo": 0.9,
        "eta": 1.4,
        **({"edge": boundary} if boundary else {}),
    }
    ball = {"type": "sphere", "id": "ball", "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "ball": ball, "sky": {"type": "constant"}})
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("boundary.eta"))
    parameters[key] = 1.6
    with pytest.raises((ValueError, RuntimeError), match="eta 1.4 of the medium"):
        parameters.update()
    assert float(np.ravel(mi.traverse(scene)[key])[0]) == pytest.approx(1.4, abs=1e-6)
