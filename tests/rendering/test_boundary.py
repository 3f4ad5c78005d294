"""The smooth boundary against Mitsuba's dielectric, whose events it has bit for bit, and what stands in its place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

from halfspace_sss.rendering.object.objects import object_of  # noqa: E402
from halfspace_sss.rendering.object.translucent import is_smooth_boundary, smooth_boundary  # noqa: E402
from halfspace_sss.rendering.scenes.mitsuba_scene import with_media  # noqa: E402

N, BOTH = 4000, 0xFFFFFFFF


@pytest.fixture(autouse=True)
def rendering() -> None:
    from halfspace_sss import rendering

    mi.set_variant("llvm_ad_rgb")
    rendering.register()


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


@pytest.mark.parametrize("tint", ["specular_reflectance", "specular_transmittance"])
def test_a_tinted_boundary_is_refused_by_models_and_traced_by_walks(tint: str) -> None:
    bsdf = {"type": "translucent", "sigma_s": 1.0, "sigma_a": 0.5, "eta": 1.4, "inner": dielectric(1.4, **{tint: 0.5})}
    described = {
        "type": "scene",
        "ball": {"type": "sphere", "radius": 3.0, "bsdf": bsdf},
        "light": {"type": "constant"},
    }
    loaded = mi.load_dict(described)
    message = f"the boundary of object 'ball' must be without {tint} under a model"
    for ask in (mi.load_dict({"type": "bssrdf"}).prepare, lambda scene: object_of(scene, None, 1.0)):
        with pytest.raises(ValueError, match=message):
            ask(loaded)
    mi.load_dict({"type": "translucent_walk"}).tracer(loaded)


def test_volume_paths_meet_the_dielectric_of_mitsuba() -> None:
    ball = {"type": "sphere", "bsdf": {"type": "translucent", "sigma_s": 1.0, "sigma_a": 0.5, "eta": 1.4}}
    found = with_media({"type": "scene", "ball": ball, "light": {"type": "constant"}}, 1.0)
    boundary = found.shapes()[0].bsdf()
    assert boundary.class_name() == "SmoothDielectric" and mi.traverse(boundary)["eta"] == pytest.approx(1.4)
