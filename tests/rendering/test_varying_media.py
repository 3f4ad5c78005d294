"""Media that vary in space: against Mitsuba's heterogeneous medium, homogeneous ones and layers with known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_translucent_walk import _cube, _lamp, _runs, _scene, _small_lamp, _z

from benchmarks.mitsuba_media import with_media
from halfspace_sss import Medium

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

WIDEST_Z = 6.0  # Student's t with about 10 degrees of freedom
N = 2**16


def _box(side: float) -> Any:
    """Unit cube to a cube about the origin."""
    return mi.ScalarTransform4f().scale(side).translate([-0.5, -0.5, -0.5])


def _grid(values: np.ndarray, to_world: Any = None, **more: Any) -> dict:
    grid = mi.VolumeGrid(np.asarray(values, dtype=np.float32))
    return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": to_world or _box(20.0), **more}


def _cloud(channels: int, low: float, high: float, seed: int = 1) -> np.ndarray:
    return low * (high / low) ** np.random.default_rng(seed).random((4, 5, 6, channels))


def _varying(**more: Any) -> dict:
    return {
        "sigma_t": _grid(_cloud(3, 0.1, 2.0)),
        "albedo": _grid(_cloud(3, 0.7, 0.99, 2)),
        "g": 0.4,
        "eta": 1.3,
        **more,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("surface", "shape"),
    [
        ({}, "sphere"),
        ({"scale": 0.3, "albedo": "0.9,0.5,0.99", "g": 0.0, "eta": 1.5}, "cube"),
    ],
    ids=["both", "extinction"],
)
def test_images_agree_with_the_heterogeneous_medium_of_mitsuba(surface: dict, shape: str) -> None:
    scene = _scene(_varying(**surface), _lamp(), _cube() if shape == "cube" else None, mm_per_unit=1.2)
    theirs = with_media(scene, 1.2, {"type": "volpathmis", "max_depth": -1, "rr_depth": 1000})
    assert np.abs(_z(_runs(mi.load_dict(scene), 6, 128, 1), _runs(theirs, 6, 128, 1001))).max() < WIDEST_Z


@pytest.mark.parametrize(("light", "orders"), [("lamp", "total"), ("small", "multiple"), ("small", "single")])
def test_a_grid_that_is_the_same_everywhere_is_a_homogeneous_medium(light: str, orders: str) -> None:
    """Under the small lamp joins bring the multiple scattering, and the guide the single one."""
    lamp = _lamp() if light == "lamp" else _small_lamp()
    spread = np.ones((2, 3, 4, 3))
    grids = {"sigma_t": _grid([0.51, 1.1, 2.5] * spread), "albedo": _grid([0.98, 0.9, 0.8] * spread)}
    same = {"sigma_t": "0.51,1.1,2.5", "albedo": "0.98,0.9,0.8"}
    a, b = (
        _runs(mi.load_dict(_scene({**medium, "g": 0.5, "eta": 1.4, "orders": orders}, lamp)), 6, 128, seed)
        for medium, seed in ((grids, 1), (same, 100))
    )
    assert np.abs(_z(a, b)).max() < WIDEST_Z


@pytest.mark.slow
def test_null_collisions_change_nothing() -> None:
    """A bright voxel beyond the object raises the majorant, nothing else."""
    values = np.ones((1, 1, 8, 3)) * [0.51, 1.1, 2.5]
    values[..., -1, :] = [5.0, 2.0, 40.0]
    wide = mi.ScalarTransform4f().translate([-10, -10, -10]).scale([80, 20, 20])  # the object is in the first quarter
    grids = {"sigma_t": _grid(values, wide), "albedo": "0.98,0.9,0.8"}
    same = {"sigma_t": "0.51,1.1,2.5", "albedo": "0.98,0.9,0.8"}
    a, b = (
        _runs(mi.load_dict(_scene({**medium, "g": 0.5, "eta": 1.4}, _lamp())), 6, 128, seed)
        for medium, seed in ((grids, 1), (same, 100))
    )
    assert np.abs(_z(a, b)).max() < WIDEST_Z


@pytest.mark.slow
def test_connections_and_directions_bring_the_light_that_chance_brings() -> None:
    surface = _varying(reflection=False, g=0.0)
    joined, left_to_chance = (
        _runs(mi.load_dict(_scene(surface, _small_lamp(), _cube(), connection_share=share)), 12, spp, 1)
        for share, spp in ((0.5, 64), (0.0, 1024))
    )
    assert np.abs(_z(joined, left_to_chance)).max() < WIDEST_Z
    assert 64 * np.median(joined.var(axis=0)) < 0.2 * 1024 * left_to_chance.var(axis=0).mean()


def _slab(thickness: float) -> dict:
    """A box below z = 0."""
    where = mi.ScalarTransform4f().translate([0, 0, -0.5 * thickness]).scale([2000, 2000, 0.5 * thickness])
    return {"type": "cube", "to_world": where}


def _layers(values: list, thickness: float, **more: Any) -> dict:
    """Layers from below to z = 0."""
    where = mi.ScalarTransform4f().translate([-2000, -2000, -thickness]).scale([4000, 4000, thickness])
    return _grid(np.asarray(values, dtype=float).reshape(len(values), 1, 1, -1), where, **more)


def _exits(surface: dict, thickness: float, mu: float, seed: int) -> Any:
    from full_geometry.geometry.points import SurfacePoint
    from full_geometry.walk.media import WalkMedia
    from full_geometry.walk.random_walk import exits

    scene = {"type": "scene", "object": {**_slab(thickness), "bsdf": {"type": "translucent", **surface}}}
    w = np.repeat([[np.sqrt(1 - mu * mu)], [0.0], [mu]], N, axis=1)
    up = np.repeat([[0.0], [0.0], [1.0]], N, axis=1)
    start = SurfacePoint(mi.Point3f(np.zeros((3, N))), mi.Normal3f(up), mi.Normal3f(up), mi.Vector3f(w))
    return exits(WalkMedia.of(mi.load_dict(scene), 1.0), 0, start, seed)


def _sides(out: Any) -> np.ndarray:
    """Throughput per walk that leaves above, and that leaves below; shape (2, channels, walks)."""
    up = np.array(out.at.n_out)[2] > 0
    T = np.array(out.T)
    return np.array([T * up, T * ~up])


@pytest.mark.parametrize("eta", [1.0, 1.4])
def test_layers_of_one_albedo_reflect_and_transmit_as_a_homogeneous_slab_of_their_thickness(eta: float) -> None:
    layers = np.array([[0.1, 2.0, 0.5], [3.0, 0.2, 0.5], [0.0, 0.4, 0.1], [1.0, 0.2, 0.3]])
    same = {"albedo": "0.95,0.8,0.99", "g": 0.6, "eta": eta}
    a = _sides(_exits({**same, "sigma_t": _layers(layers, 4.0)}, 4.0, 0.7, 1))
    sigma_t = ",".join(map(str, layers.mean(axis=0)))  # also of layers with linear interpolation between
    b = _sides(_exits({**same, "sigma_t": sigma_t}, 4.0, 0.7, 2))
    z = (a.mean(axis=-1) - b.mean(axis=-1)) / np.sqrt((a.var(axis=-1) + b.var(axis=-1)) / N)
    assert np.abs(z).max() < 4.4


@pytest.mark.parametrize("filter_type", ["trilinear", "nearest"])
def test_layers_that_only_absorb_transmit_by_their_optical_thickness(filter_type: str) -> None:
    layers = np.array([[0.1, 2.0, 0.5], [0.6, 0.2, 0.5], [0.0, 0.4, 0.1]])
    surface = {"sigma_t": _layers(layers, 3.0, filter_type=filter_type), "albedo": 0.0, "eta": 1.0}
    out = _exits(surface, 3.0, 0.8, 3)
    assert not np.array(out.order).any()
    T = _sides(out)[1]
    expected = np.exp(-3.0 * layers.mean(axis=0) / 0.8)
    assert np.abs((T.mean(axis=-1) - expected) / np.sqrt(T.var(axis=-1) / N)).max() < 4.4


def test_ratio_tracking_is_unbiased_in_every_channel() -> None:
    import drjit as dr

    from full_geometry.walk.media import WalkMedia

    layers = np.array([[0.1, 2.0, 0.5], [0.6, 0.2, 0.5], [0.0, 0.4, 0.1]])
    scene = {"type": "scene", "object": {**_slab(3.0), "bsdf": {
        "type": "translucent", "sigma_t": _layers(layers, 3.0), "scale": 1.5, "albedo": 0.5}}}  # fmt: skip
    media = WalkMedia.of(mi.load_dict(scene), 2.0)
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), dr.normalize(mi.Vector3f(1, 0, -2)))
    rng = mi.PCG32(N)
    length = 3.0 * np.sqrt(5) / 2
    T = np.array(media.transmittance(dr.zeros(mi.UInt32, N), ray, dr.full(mi.Float, length, N), rng))
    expected = np.exp(-layers.mean(axis=0) * 1.5 * 2.0 * length)
    assert np.abs((T.mean(axis=-1) - expected) / np.sqrt(T.var(axis=-1) / N)).max() < 4.4


def test_a_scale_may_vary_instead_of_the_extinction() -> None:
    layers = np.array([0.2, 1.0, 0.4])
    by_scale = {"sigma_t": "1,0.5,2", "scale": _layers(layers, 3.0)}
    by_sigma_t = {"sigma_t": _layers(layers[:, None] * [1, 0.5, 2], 3.0)}
    a, b = (
        _sides(_exits({**medium, "albedo": "0.9,0.8,0.99", "eta": 1.2}, 3.0, 0.7, 5))
        for medium in (by_scale, by_sigma_t)
    )
    assert np.allclose(a.mean(axis=-1), b.mean(axis=-1), rtol=2e-3)


def test_objects_that_vary_and_homogeneous_ones_stand_in_one_scene() -> None:
    scene = _scene(_varying(), _lamp(), {"type": "sphere", "radius": 4.0, "center": [-5, 0, 0]})
    other = {"type": "translucent", "sigma_s": 1.0, "sigma_a": "1,0.1,0.01", "g": 0.5, "eta": 1.3}
    scene["other"] = {"type": "sphere", "radius": 4.0, "center": [5, 0, 0], "bsdf": other}
    third = {"type": "translucent", **_varying(sigma_t=_grid(_cloud(1, 0.1, 2.0, 5)), albedo="0.9,0.8,0.7")}
    scene["third"] = {"type": "sphere", "radius": 3.0, "center": [0, 6, 0], "bsdf": third}
    theirs = with_media(scene, 1.0, {"type": "volpathmis", "max_depth": -1, "rr_depth": 1000})
    assert np.abs(_z(_runs(mi.load_dict(scene), 6, 128, 1), _runs(theirs, 6, 128, 100))).max() < WIDEST_Z


@pytest.mark.slow
def test_a_mono_variant_takes_grids_of_one_channel() -> None:
    mi.set_variant("llvm_ad_mono")
    surface = {"sigma_t": _grid(_cloud(1, 0.1, 2.0)), "albedo": _grid(_cloud(1, 0.7, 0.99, 2)), "g": 0.4}
    scene = _scene(surface, _lamp())
    theirs = with_media(scene, 1.0, {"type": "volpathmis", "max_depth": -1, "rr_depth": 1000})
    a, b = _runs(mi.load_dict(scene), 6, 128, 1)[..., :1], _runs(theirs, 6, 128, 100)[..., :1]
    assert np.abs(_z(a, b)).max() < WIDEST_Z


def test_models_of_the_half_space_take_the_means_over_the_object() -> None:
    from full_geometry.settings import Settings
    from full_geometry.transport.prepare import make_objects

    layers = np.array([[1.0, 2.0, 4.0], [3.0, 2.0, 8.0], [50.0, 50.0, 50.0], [50.0, 50.0, 50.0]])
    where = mi.ScalarTransform4f().translate([-10, -10, -10]).scale([20, 20, 40])  # the object is in the lower half
    values = layers.reshape(4, 1, 1, 3)
    surface = {"sigma_t": _grid(values, where, filter_type="nearest"), "albedo": 0.75, "model": "better_dipole"}
    with pytest.warns(UserWarning, match="takes its mean sigma_s"):
        bodies = make_objects(mi.load_dict(_scene(surface)), Settings())
    for medium, sigma_t in zip(bodies[0].media, (2.0, 2.0, 6.0)):
        assert medium.sigma_s == pytest.approx(0.75 * sigma_t, rel=0.02)
        assert medium.sigma_a == pytest.approx(0.25 * sigma_t, rel=0.02)


def test_a_scale_that_varies_under_a_coloured_extinction_has_no_counterpart_in_mitsuba() -> None:
    surface = {"sigma_t": "1,0.5,2", "scale": _grid(_cloud(1, 0.1, 2.0)), "albedo": 0.5}
    with pytest.raises(ValueError, match="sigma_t must be a grid of all channels for Mitsuba's media"):
        with_media(_scene(surface), 1.0)


def test_constant_volumes_and_numbers_are_the_homogeneous_medium() -> None:
    flat = {"type": "constvolume", "value": {"type": "rgb", "value": [0.9, 0.5, 0.1]}}
    surface = {"type": "translucent", "sigma_t": 2.0, "scale": 1.5, "albedo": flat, "g": 0.2, "eta": 1.4}
    inside = mi.load_dict(surface).spec
    assert inside.varying is None
    assert inside.medium == Medium.from_albedo(np.float32([0.9, 0.5, 0.1]).astype(float), np.full(3, 3.0), 0.2, 1.4)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"sigma_t": np.full((2, 2, 2, 1), np.nan)}, "sigma_t must be finite and >= 0, got nan"),
        ({"sigma_t": np.full((2, 2, 2, 1), -1.0)}, "sigma_t must be finite and >= 0, got -1.0"),
        ({"sigma_t": np.zeros((2, 2, 2, 1))}, "sigma_t must be > 0 somewhere in each channel"),
        ({"sigma_t": np.ones((2, 2, 2, 2))}, "sigma_t must be a grid of 1 or 3 channels, got 2"),
        ({"albedo": np.full((2, 2, 2, 1), 1.5)}, r"albedo must be in \[0, 1\], got 1.5"),
        ({"albedo": np.full((2, 2, 2, 1), -0.5)}, r"albedo must be in \[0, 1\], got -0.5"),
        ({"g": np.zeros((2, 2, 2, 1))}, "g must be constant, got a volume"),
        ({"eta": np.ones((2, 2, 2, 1))}, "eta must be constant, got a volume"),
        ({"sigma_t": np.ones((2, 2, 2, 1)), "scale": np.ones((2, 2, 2, 1))}, "scale must be a number where sigma_t"),
        ({"sigma_t": np.ones((2, 2, 2, 1)), "scale": -2.0}, "scale must be finite and >= 0, got -2.0"),
        ({"scale": np.ones((2, 2, 2, 3))}, "scale must be a grid of 1 channel, got 3"),
    ],
)
def test_grids_that_are_no_media_are_refused(parameters: dict, message: str) -> None:
    grids = {key: _grid(value) if isinstance(value, np.ndarray) else value for key, value in parameters.items()}
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "translucent", "sigma_t": 1.0, "albedo": 0.5, **grids})


def test_volumes_that_are_no_grids_are_refused() -> None:
    from full_geometry.surface.varying import varying_medium

    class Ramp(mi.Volume):
        pass

    with pytest.raises(ValueError, match="sigma_t must be a number, a constvolume or a gridvolume, got a "):
        varying_medium(Ramp(mi.Properties()), 0.5, 1.0, 3)
