"""Light that walks find precomputed inside objects: cells, means against sampled light, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered import independent

pytestmark = pytest.mark.usefixtures("rgb")

dr, mi = pytest.importorskip("drjit"), pytest.importorskip("mitsuba")

WIDEST_Z = 4.4  # two-sided 1e-5
WHITE = {"sigma_s": "1.0,2.0,3.0", "sigma_a": 0.0, "eta": 1.5}
MEDIUM = {"sigma_s": "1.0,1.5,2.0", "sigma_a": "0.01,0.05,0.3", "eta": 1.4}
PAINTED = {"albedo": {"type": "checkerboard", "color0": 0.5, "color1": 0.95}, "sigma_t": 1.5, "eta": 1.4}


def _ball(radius: float = 5.0, **to_world: Any) -> dict:
    return {"type": "sphere", "radius": radius, **to_world}


def _cube() -> dict:
    return {"type": "cube", "to_world": mi.ScalarTransform4f().scale(4).rotate([0.6, 0.8, 0], 30)}


def _lamp(size: float = 6.0) -> dict:
    to_world = mi.ScalarTransform4f().look_at([20, 25, 10], [0, 0, 0], [0, 1, 0]).scale(size)
    return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": 20.0}}


def _scene(how: str, surface: dict, shape: dict | None = None, pixels: int = 8, **more: Any) -> Any:
    """An object of about 10 units from the front, and what else is given."""
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([0, 10, 40], [0, 0, 0], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "translucent_walk", "light": how},
            "sensor": {"type": "perspective", "fov": 16.0, "to_world": view, "film": film},
            "object": {**(shape or _ball()), "bsdf": {"type": "translucent", **surface}},
            **more,
        }
    )


def _means(scene: Any, runs: int, spp: int, seed: int) -> np.ndarray:
    return independent(scene, runs, spp, seed).mean(axis=(1, 2))


def _compare(
    surface: dict, known_to: float, shape: dict | None = None, spp: int = 1024, fewer: int = 4, runs: int = 5,
    **more: Any,
) -> None:  # fmt: skip
    """Mean colours with precomputed and with sampled light agree, and are known to a share of themselves.

    Precomputed light of lamps has less noise, and takes `fewer` times fewer samples, in `runs` launches with cells of
    their own.
    """
    found, wanted = (
        _means(_scene(light, surface, shape, **more), launches, n, seed)
        for light, launches, n, seed in (("precomputed", runs, spp // fewer, 1), ("sampled", 12, spp, 101))
    )
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (found, wanted)))
    assert (error < known_to * wanted.mean(axis=0)).all(), error / wanted.mean(axis=0)
    bias = 0.003 * wanted.mean(axis=0)  # of cells
    assert (np.abs(found.mean(axis=0) - wanted.mean(axis=0)) < WIDEST_Z * error + bias).all()


# ---- cells


def _cells(shape: dict, surface: dict = MEDIUM, **more: Any) -> Any:
    from full_geometry.precomputed.unscattered_light import inside_cells_of
    from full_geometry.walk.media import WalkMedia

    scene = _scene("precomputed", surface, shape, light={"type": "constant"}, **more)
    return inside_cells_of(WalkMedia.of(scene, 1.0))[0]


def _moments(cells: Any) -> tuple[np.ndarray, ...]:
    """Slots of cells that do not share the fit of another, their centres, edges and moments, with those that do."""
    # ---- places of slots in fine and in coarse bricks
    brick, slot = (np.array(v) for v in (cells.index.brick, cells.index.slot))
    centre, edge = np.full((cells.slots, 3), np.nan), np.full(cells.slots, cells.h)
    for n in (4, 2):
        number = np.flatnonzero((brick >= 0) & (brick % 2 == (n == 2)))
        at = slot[brick[number, None] // 2 + np.arange(n**3)]
        corner = np.stack(np.unravel_index(number, cells.counts[::-1])[::-1], axis=1)
        place = np.stack(np.unravel_index(np.arange(n**3), (n, n, n))[::-1], axis=1)
        middle = cells.low + 4 * cells.h * (corner[:, None] + (place + 0.5) / n)
        centre[at[at >= 0]], edge[at[at >= 0]] = middle[at >= 0], 4 / n * cells.h
    assert np.isfinite(centre).all()

    # ---- moments, of cut cells the inverse of their solution without its ridge
    M = np.zeros((cells.slots, 4, 4)) + np.diag([1, 1 / 12, 1 / 12, 1 / 12])
    cut, place = np.array(cells.cut), np.array(cells.place)
    M[cut] = np.linalg.inv(np.array(cells.solve, dtype=float).reshape(-1, 4, 4))
    M[cut] -= 0.02 / 12 * M[cut, :1, :1] * np.diag([0, 1, 1, 1])
    own = np.setdiff1d(np.arange(cells.slots), cut[place != np.arange(len(place))])
    return own, centre[own], edge[own], M[own]


@pytest.mark.parametrize(("shape", "volume"), [(_ball, 4 / 3 * np.pi * 125), (_cube, 512.0)])
def test_cells_have_the_volume_of_an_object(shape: Any, volume: float) -> None:
    _, _, edge, M = _moments(_cells(shape()))
    assert (M[:, 0, 0] * edge**3).sum() == pytest.approx(volume, rel=2e-3)


def _held(kind: str, x: float = 1.0, radius: float = 2.0) -> dict:
    """A ball, or a sheet, below the surface of a ball of 5 towards lamp and camera."""
    place = {"center": [x, 1.0, 2.0]}
    surfaces = {"stone": {"type": "diffuse", "reflectance": 0.7}, "medium": {"type": "translucent", **WHITE},
                "bubble": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}}  # fmt: skip
    if kind == "sheet":
        at = mi.ScalarTransform4f().translate(place["center"]).scale(2)
        return {"type": "disk", "to_world": at, "bsdf": {"type": "twosided", "bsdf": surfaces["stone"]}}
    return {**_ball(radius, **place), "bsdf": surfaces[kind]}


def _block() -> dict:
    """Glass that fills the space below the middle of a ball of 5."""
    to_world = mi.ScalarTransform4f().translate([0, -4, 0]).scale([8, 4, 8])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}


@pytest.mark.parametrize("kind", ["stone", "bubble", "medium", "sheet"])
def test_cells_leave_out_what_lies_inside_an_object(kind: str) -> None:
    """A sheet has no volume."""
    _, _, edge, M = _moments(_cells(_ball(), held=_held(kind)))
    volume = 4 / 3 * np.pi * (125 - 8 * (kind != "sheet"))
    assert (M[:, 0, 0] * edge**3).sum() == pytest.approx(volume, rel=2e-3)


def test_cells_leave_out_the_part_of_an_eye_that_lies_inside_a_ball() -> None:
    """Balls of radii R and r, d apart, share pi (R + r - d)² (d² + 2 d (R + r) - 3 (R - r)²) / 12 d."""
    eye = {**_ball(2.0, center=[0.0, 0.0, 5.0]), "bsdf": {"type": "diffuse"}}
    _, _, edge, M = _moments(_cells(_ball(), held=eye))
    shared = np.pi * 2**2 * (5**2 + 2 * 5 * 7 - 3 * 3**2) / (12 * 5)
    assert (M[:, 0, 0] * edge**3).sum() == pytest.approx(4 / 3 * np.pi * 125 - shared, rel=5e-4)


@pytest.mark.parametrize(("priority", "share"), [(-1.0, 0.5), (1.0, 1.0)])
def test_cells_of_a_ball_half_in_glass_hold_what_has_the_larger_priority(priority: float, share: float) -> None:
    """Glass of priority 0 takes the lower half of a ball, or none of it."""
    _, _, edge, M = _moments(_cells(_ball(), {**MEDIUM, "priority": priority}, glass=_block()))
    assert (M[:, 0, 0] * edge**3).sum() == pytest.approx(share * 4 / 3 * np.pi * 125, rel=1e-3)


def test_cells_of_two_balls_that_overlap_hold_each_place_once() -> None:
    """Balls of radius R, d apart, share pi (4 R + d) (2 R - d)² / 12."""
    from full_geometry.precomputed.unscattered_light import inside_cells_of
    from full_geometry.walk.media import WalkMedia

    other = {**_ball(4.0, center=[5, 0, 0]), "bsdf": {"type": "translucent", **WHITE, "priority": 1.0}}
    scene = _scene("precomputed", MEDIUM, _ball(4.0), light={"type": "constant"}, other=other)
    cells = inside_cells_of(WalkMedia.of(scene, 1.0))
    volumes = [(M[:, 0, 0] * edge**3).sum() for _, _, edge, M in map(_moments, cells)]
    ball, shared = 4 / 3 * np.pi * 64, np.pi * (16 + 5) * (8 - 5) ** 2 / 12
    assert sorted(volumes) == pytest.approx([ball - shared, ball], rel=1e-3)


def test_cells_know_the_second_moments_of_a_ball() -> None:
    """∫ x² of a ball is 4/15 pi R^5."""
    _, centre, edge, M = _moments(_cells(_ball()))
    V, x, xx = M[:, :1, 0], M[:, 1:, 0], np.einsum("sjj->sj", M[:, 1:, 1:])
    edge = edge[:, None]
    total = ((V * centre**2 + 2 * edge * x * centre + edge**2 * xx) * edge**3).sum(axis=0)
    assert total == pytest.approx(4 / 15 * np.pi * 5**5, rel=5e-3)


def test_cells_of_an_object_of_hundreds_of_mean_free_paths_are_those_near_its_surface() -> None:
    cells = _cells(_ball(), {"sigma_s": 8.0, "sigma_a": 0.0, "eta": 1.4})
    _, centre, edge, M = _moments(cells)
    depth, free_path = 5 - np.linalg.norm(centre, axis=1), 1 / 8
    whole = M[:, 0, 0] == 1
    assert depth.max() < 25 * free_path
    # none is left out where light is
    shells = np.arange(2.5, 9) * free_path
    found = np.histogram(depth[whole], shells, weights=edge[whole] ** 3)[0]
    assert found == pytest.approx(4 / 3 * np.pi * -np.diff((5 - shells) ** 3), rel=0.1)


def test_the_fit_keeps_the_integral_over_cells_that_share_it() -> None:
    cells = _cells(_cube())
    start = np.random.default_rng(1).random((cells.slots, 3, 4), dtype=np.float32)
    D = mi.Float(start.ravel().copy())  # with whose memory it begins
    cells.share(D, 12, moments=True)
    shared = np.array(D).reshape(start.shape)
    cells.fit(D)
    fit = np.array(D).reshape(start.shape)
    cut, place = np.array(cells.cut), np.array(cells.place)
    own, _, _, M = _moments(cells)
    kept = fit[own, :, 0] * M[:, :1, 0] + np.einsum("scj,sj->sc", fit[own, :, 1:], M[:, 1:, 0]) * 12 / 1.02
    assert kept[np.isin(own, cut)] == pytest.approx(shared[own[np.isin(own, cut)], :, 0], abs=1e-4)
    inner = np.setdiff1d(np.arange(cells.slots), cut)
    assert (fit[inner] == start[inner]).all()
    assert shared[cut[np.unique(place)], :, 0].sum() == pytest.approx(start[cut, :, 0].sum(), rel=1e-5)


# ---- images


@pytest.mark.slow
def test_a_medium_without_absorption_is_invisible_in_uniform_light() -> None:
    means = _means(_scene("precomputed", WHITE, light={"type": "constant"}), 8, 512, 1)
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    assert (error < 0.006).all()
    assert (np.abs(means.mean(axis=0) - 1) < WIDEST_Z * error + 0.002).all()


@pytest.mark.slow
def test_a_ball_in_a_bell_jar_without_absorption_is_invisible_in_uniform_light() -> None:
    """All of its light comes by way of the glass, at which paths of light begin."""
    jar = {**_ball(6.5), "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
    hollow = {**_ball(6.0), "bsdf": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}}
    scene = _scene("precomputed", WHITE, light={"type": "constant"}, jar=jar, hollow=hollow)
    means = _means(scene, 8, 1536, 1)
    assert len(scene.integrator().media(scene).lit_from_outside) == 3
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    assert (error < 0.006).all(), error
    assert (np.abs(means.mean(axis=0) - 1) < WIDEST_Z * error + 0.002).all(), means.mean(axis=0)


@pytest.mark.slow
def test_a_branching_object_without_absorption_is_invisible_in_uniform_light(tmp_path: Path) -> None:
    """A hand about 10 units wide, without interpolated normals, by z-tests beside a bias of .3 %."""
    meshes = pytest.importorskip("benchmarks.modelling.meshes")
    hands = pytest.importorskip("benchmarks.hand_and_ribbon")
    pytest.importorskip("igl")
    path = meshes.surface(*hands.hand(), 48).write_ply(tmp_path / "hand.ply")
    shape = {"type": "ply", "filename": str(path), "face_normals": True, "to_world": mi.ScalarTransform4f().scale(9.0)}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgba",
            "component_format": "float32"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([0, 10, 40], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 18.0, "to_world": view, "film": film}
    integrator = {"type": "translucent_walk", "light": "precomputed", "hide_emitters": True}
    scene = _scene("precomputed", WHITE, shape, integrator=integrator, sensor=sensor, light={"type": "constant"})
    found = np.array([np.array(mi.render(scene, spp=2048, seed=k)).sum(axis=(0, 1)) for k in range(6)])
    ratio = found[:, :3] / found[:, 3:]
    error = ratio.std(axis=0, ddof=1) / np.sqrt(len(ratio))
    assert (error < 0.004).all(), error
    assert (np.abs(ratio.mean(axis=0) - 1) < 0.003 + WIDEST_Z * error).all(), ratio.mean(axis=0)


@pytest.mark.slow
def test_precomputed_light_of_two_balls_that_touch_has_the_mean_of_sampled_light() -> None:
    other = {**_ball(2.5, center=[2.5, 0, 0]), "bsdf": {"type": "translucent", **MEDIUM, "sigma_s": "2.0,1.0,0.7"}}
    _compare(MEDIUM, 0.02, _ball(2.5, center=[-2.5, 0, 0]), other=other, lamp=_lamp())


@pytest.mark.slow
def test_a_lamp_that_looks_small_from_a_part_of_a_ball_has_the_same_mean_by_sampled_light() -> None:
    """Connections are made at events from which it does, and nowhere else."""
    lamp = {"type": "sphere", "center": [-19, 20, 10], "radius": 8.0, "emitter": {"type": "area", "radiance": 6.0}}
    ball, medium = _ball(4.0), {"sigma_s": 1.0, "sigma_a": 0.02, "eta": 1.5}
    _compare(medium, 0.006, ball, spp=4096, runs=8, lamp=lamp)  # 2.4 % too bright if asked at the events after those


@pytest.mark.slow
def test_precomputed_light_around_and_in_what_lies_inside_has_the_mean_of_sampled_light() -> None:
    held = {"medium": _held("medium", -1.8, 1.5), "bubble": _held("bubble", 1.8, 1.5)}
    stone = {**_ball(1.2, center=[0, -2.5, 3]), "bsdf": {"type": "diffuse", "reflectance": 0.7}}
    _compare({**MEDIUM, "g": 0.5}, 0.02, spp=320, runs=8, stone=stone, lamp=_lamp(20.0), **held)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["two media", "forward in glass"])
def test_precomputed_light_where_things_overlap_has_the_mean_of_sampled_light(case: str) -> None:
    """Light comes by way of glass and of the other object, too."""
    lights = {"lamp": _lamp(), "sky": {"type": "constant", "radiance": 0.3}}
    if case == "two media":
        other = {**_ball(4.0, center=[2.5, 0, 0]), "bsdf": {"type": "translucent", **WHITE, "priority": 1.0}}
        _compare(MEDIUM, 0.02, _ball(4.0, center=[-2, 0, 0]), 256, other=other, **lights)
        return
    _compare({**MEDIUM, "g": 0.6, "priority": -1.0}, 0.02, _ball(), 256, glass=_block(), **lights)


@pytest.mark.slow
def test_precomputed_light_has_the_mean_of_sampled_light_where_forward_scattering_varies_in_space() -> None:
    values = np.random.default_rng(3).uniform(0.4, 4.0, (4, 4, 4, 3)).astype(np.float32)
    to_world = mi.ScalarTransform4f().translate([-5, -5, -5]).scale(10)
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "to_world": to_world, "raw": True}
    surface = {"sigma_t": grid, "albedo": "0.99,0.95,0.9", "g": 0.8, "eta": 1.4}
    _compare(surface, 0.02, spp=512, lamp=_lamp(20.0), sky={"type": "constant", "radiance": 0.2})


@pytest.mark.slow
@pytest.mark.parametrize("case", ["point", "floor", "albedo"])
def test_precomputed_light_has_the_mean_of_sampled_light(case: str) -> None:
    lamp, floor = {"lamp": _lamp()}, {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    floor["to_world"] = mi.ScalarTransform4f().translate([0, -5.2, 0]).rotate([1, 0, 0], -90).scale(30)
    if case == "point":
        _compare(MEDIUM, 0.02, light={"type": "point", "position": [20, 25, 10], "intensity": 900.0})
    elif case == "floor":
        _compare(MEDIUM, 0.02, spp=256, runs=8, floor=floor, **lamp)
    else:
        _compare(PAINTED, 0.01, _cube(), spp=768, **lamp)


# ---- phase functions that are split


@pytest.mark.parametrize("g", [-0.95, -0.3, 0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 0.999])
def test_what_is_left_of_a_phase_function_is_forward_and_at_most_all_of_it(g: float) -> None:
    from full_geometry.precomputed.forward_scattering import kept_forward
    from halfspace_sss.physics.medium import eval_hg

    c = np.concatenate([np.linspace(-1, 0.9, 4000), 1 - np.geomspace(0.1, 1e-7, 4000)]) * (1 if g >= 0 else -1)
    kept = np.array(kept_forward(mi.Float(c), mi.Spectrum(g)))[0].astype(float)
    assert -0.13 < kept.min() and kept.max() <= 1 + 1e-5
    backward = c * np.sign(g or 1) < 0
    p = eval_hg(c, np.full_like(c, g)) * np.abs(np.gradient(c))
    assert (p * kept**2)[backward].sum() < 0.05 * p[backward].sum()  # one-sided quadratics leave .6 there at g = .9


FORWARD = {"sigma_s": "5.0,7.5,10.0", "sigma_a": "0.01,0.05,0.3", "eta": 1.4}


@pytest.mark.parametrize(
    "g", [pytest.param("0.95,0.8,0.6", marks=pytest.mark.slow), pytest.param("-0.6", marks=pytest.mark.slow)]
)
def test_precomputed_light_of_an_even_sky_has_the_mean_of_sampled_light_at_any_g(g: str) -> None:
    surface = {**(MEDIUM if g == "-0.6" else FORWARD), "g": g}
    _compare(surface, 0.003, _ball(3.0), spp=256, fewer=1, light={"type": "constant"})


@pytest.mark.slow
@pytest.mark.parametrize("case", ["rough", "thin"])
def test_precomputed_light_of_a_lamp_has_the_mean_of_sampled_light_where_scattering_is_forward(case: str) -> None:
    """A lamp as wide as the object, so that sampled light is known to 1 %."""
    lamp = {"lamp": _lamp(15.0)}
    if case == "rough":
        rough = {"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.4, "ext_ior": 1.0}
        _compare({**FORWARD, "g": 0.8, "boundary": rough}, 0.012, spp=1536, runs=8, **lamp)
    else:  # 5 mean free paths
        _compare({**MEDIUM, "g": 0.9}, 0.02, _ball(2.0), spp=6144, fewer=2, runs=10, **lamp)


def _behind(seeds: int, chance: bool = False, cut: bool = False) -> np.ndarray:
    """Mean light (seeds, 3) of a ball of a forward medium with a small lamp behind it, of whose light few paths of the
    same rays leave the ball towards it by chance."""
    from full_geometry.integrators.glints import glints_of
    from full_geometry.precomputed.unscattered_light import ImageSamples

    lamp = {"type": "sphere", "center": [-14, 9, -20], "radius": 1.5, "emitter": {"type": "area", "radiance": 200.0}}
    surface = {"sigma_s": "2.0,3.0,4.0", "sigma_a": "0.05,0.1,0.3", "eta": 1.4, "g": 0.9}
    scene = _scene("precomputed", surface, _ball(3.0), lamp=lamp)
    places = np.random.default_rng(1).random((2, 2**17), dtype=np.float32)
    rays, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(*map(mi.Float, places)), mi.Point2f(0.5))
    found = []
    with dr.suspend_grad():
        for seed in range(seeds):
            tracer = scene.integrator().tracer(scene, seed, ImageSamples(2**14, 64))
            assert tracer.visitor.forward and tracer.visitor.directions is not None
            if chance:
                tracer = replace(tracer, visitor=replace(tracer.visitor, directions=None))
            most = glints_of(tracer, scene.sensors()[0], 4).brightest if cut else dr.opaque(mi.Float, np.inf)
            light, hit, _ = replace(tracer, brightest=most).trace(rays, 2**12, (seed, 1))
            found.append(np.array(light)[:, np.array(hit)].mean(axis=1))
    return np.array(found)


@pytest.mark.slow
def test_directions_to_a_lamp_after_forward_events_have_the_mean_of_chance() -> None:
    found, wanted = _behind(6), _behind(16, chance=True)
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (found, wanted)))
    assert (error < 0.05 * wanted.mean(axis=0)).all(), error / wanted.mean(axis=0)
    assert (np.abs(found.mean(axis=0) - wanted.mean(axis=0)) < WIDEST_Z * error).all()


@pytest.mark.slow
def test_a_small_lamp_behind_a_forward_medium_loses_little_light_to_the_cut() -> None:
    assert (_behind(4, cut=True) > 0.98 * _behind(4)).all()


@pytest.mark.slow
def test_light_of_a_window_has_a_fraction_of_the_noise_of_sampled_light() -> None:
    sky = np.full((32, 64, 3), 0.1, dtype=np.float32)
    sky[6:12, 8:14] = 20
    noise = []
    for how in ("precomputed", "sampled"):
        scene = _scene(how, MEDIUM, sky={"type": "envmap", "bitmap": mi.Bitmap(sky)})
        noise.append(np.var([mi.render(scene, spp=64, seed=k) for k in range(6)], axis=0).sum())
    assert noise[0] < 0.05 * noise[1]  # .06 if walks went on beyond their third event


@pytest.mark.slow
def test_the_mirror_image_of_a_lamp_that_fills_a_small_part_of_a_pixel_is_found(tmp_path: Path) -> None:
    """F L times the area of the image in a mirror of focal length R / 2, in pixels; R = 5, the lamp 29 away, F = 0.0293
    at 31 degrees. A fifty thousandth of a pixel, on a mesh."""
    light = _lamp(0.005)
    light["emitter"]["radiance"] *= (0.2 / 0.005) ** 2
    shape = {"type": "ply", "filename": _mesh_ball(tmp_path)}
    image = np.array(mi.render(_scene("precomputed", MEDIUM, shape, pixels=64, lamp=light), spp=32, seed=1)).sum(axis=2)
    row, column = np.unravel_index(image.argmax(), image.shape)
    glint = image[row - 1 : row + 2, column - 1 : column + 2].sum() - 9 * np.median(image[image > 0])
    pixel = 2 * np.tan(np.radians(8)) * 38 / 64
    assert glint == pytest.approx(3 * 20 * 0.0293 * (0.4 * 2.5 / (29 + 2.5) / pixel) ** 2, rel=0.15)


def test_light_of_small_emitters_that_few_paths_meet_is_cut_and_no_other() -> None:
    """Of two balls under a lamp of .1 radians: a ray is as bright as without a cut, or was brighter than its bound."""
    from full_geometry.precomputed.unscattered_light import ImageSamples

    other = {**_ball(2.5, center=[2.5, 0, 0]), "bsdf": {"type": "translucent", **MEDIUM}}
    light = _lamp(1.5)
    light["emitter"]["radiance"] *= (6.0 / 1.5) ** 2
    scene = _scene("precomputed", MEDIUM, _ball(2.5, center=[-2.5, 0, 0]), other=other, lamp=light)
    places = np.random.default_rng(1).random((2, 2**18), dtype=np.float32)
    rays, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(*map(mi.Float, places)), mi.Point2f(0.5))
    tracer, images = scene.integrator().tracer(scene, 0, ImageSamples(2**14, 64)), []
    for brightest in (np.inf, 0.2):
        bound = replace(tracer, brightest=dr.opaque(mi.Float, brightest))
        with dr.suspend_grad():
            images.append(np.array(bound.trace(rays, 2**12, (1,))[0]))
    whole, cut = images
    differs = (whole != cut).any(axis=0)
    assert differs.sum() > 3
    assert (whole[:, differs].max(axis=0) > 0.2).all()
    assert (cut <= whole).all()


def _mesh_ball(folder: Path, rows: int = 64) -> str:
    """The file of a ball of radius 5 with normals, by rows of faces with twice as many columns."""
    from full_geometry.geometry.mesh import fill, set_vertex_normals

    columns = 2 * rows + 1
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns), indexing="ij")
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    at = np.arange(len(d)).reshape(-1, columns)
    a, b, c, e = (v.ravel() for v in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, e], axis=1)])
    ball = mi.Mesh("ball", len(d), len(faces), has_vertex_normals=True)
    fill(ball, 5 * d, faces)
    set_vertex_normals(ball, d)
    ball.write_ply(str(folder / "ball.ply"))
    return str(folder / "ball.ply")


def test_the_same_seed_gives_the_same_picture_and_another_seed_other_light() -> None:
    scene = _scene("precomputed", MEDIUM, lamp=_lamp())
    a, b, c = (np.array(mi.render(scene, spp=4, seed=seed)) for seed in (3, 3, 4))
    assert np.abs(a - b).max() < 1e-5 * a.max()
    assert np.abs(a - c).max() > 1e-3 * a.max()


def test_an_edited_emitter_lights_the_next_picture() -> None:
    scene = _scene("precomputed", MEDIUM, lamp=_lamp())
    before = np.array(mi.render(scene, spp=16, seed=1)).mean()
    parameters = mi.traverse(scene)
    parameters["lamp.emitter.radiance.value"] = 40.0
    parameters.update()
    assert np.array(mi.render(scene, spp=16, seed=1)).mean() == pytest.approx(2 * before, rel=1e-4)


@pytest.mark.slow
def test_an_object_of_another_medium_has_other_cells() -> None:
    scene = _scene("precomputed", MEDIUM, lamp=_lamp())
    mi.render(scene, spp=1)
    parameters = mi.traverse(scene)
    parameters["object.bsdf.sigma_t"] = parameters["object.bsdf.sigma_t"] * 3
    parameters.update()
    denser = {"sigma_s": "3.0,4.5,6.0", "sigma_a": "0.03,0.15,0.9", "eta": 1.4}
    found, wanted = (
        np.array(mi.render(s, spp=16, seed=1)) for s in (scene, _scene("precomputed", denser, lamp=_lamp()))
    )
    assert found.mean() == pytest.approx(wanted.mean(), rel=2e-3)  # rounding parts a few paths


def test_the_layer_of_emission_holds_the_mirror_and_what_is_behind_the_object() -> None:
    """Of an object that scatters nothing back, all light is mirrored, or passes beside it."""
    black = {"sigma_s": 1e-6, "sigma_a": 5.0, "eta": 1.4}
    scene = _scene("auto", black, light={"type": "constant"})
    integrator = mi.load_dict({"type": "translucent_walk", "light": "precomputed", "layers": True})
    image = np.array(mi.render(scene, spp=64, seed=1, integrator=integrator))
    assert image.shape == (8, 8, 6)
    assert image[..., 3:] == pytest.approx(image[..., :3], abs=1e-4)


CLEAR = {"sigma_s": 1e-6, "sigma_a": 0.06, "eta": 1.4}


def _window() -> dict:
    sky = np.full((16, 32, 3), 0.1, dtype=np.float32)
    sky[2:6, 8:14] = 20.0
    return {"type": "envmap", "bitmap": mi.Bitmap(sky)}


@pytest.mark.parametrize(("what", "follows"), [("clear", True), ("dense", False), ("sun", False)])
def test_reflections_are_followed_in_clear_objects_unless_an_emitter_is_as_small_as_a_sun(
    what: str, follows: bool
) -> None:
    from full_geometry.precomputed.unscattered_light import ImageSamples

    lamp = _lamp(0.1) if what == "sun" else _lamp()
    scene = _scene("precomputed", MEDIUM if what == "dense" else CLEAR, _cube(), lamp=lamp)
    assert scene.integrator().tracer(scene, 0, ImageSamples(64, 64)).visitor.follows == follows


@pytest.mark.slow
def test_the_layer_of_emission_holds_what_is_seen_through_an_object_after_reflections_inside() -> None:
    """A cube that scatters nothing back and lets most light through, in a room with one window."""
    scene = _scene("auto", CLEAR, _cube(), light=_window())
    integrator = mi.load_dict({"type": "translucent_walk", "light": "precomputed", "layers": True})
    image = np.array(mi.render(scene, spp=64, seed=1, integrator=integrator))
    assert image[..., 3:] == pytest.approx(image[..., :3], abs=0.02 * float(image[..., :3].mean()))
    by_chance = mi.load_dict({"type": "translucent_walk", "light": "sampled"})
    means = np.array([mi.render(scene, spp=2048, seed=k, integrator=by_chance) for k in range(16)]).mean(axis=(1, 2, 3))
    error = means.std(ddof=1) / 4
    assert error < 0.004 * means.mean()
    assert abs(image[..., :3].mean() - means.mean()) < 4 * error


# ---- refusals


@pytest.mark.parametrize(
    ("surface", "reason"),
    [
        ({**MEDIUM, "orders": "single"}, "orders of object 'object' are 'single'"),
        ({**PAINTED, "g": 0.2}, r"abs\(g\) of object 'object' is above 0.1 in a scene with textures of media"),
        ({**MEDIUM, "sigma_s": 1e4}, "so many mean free paths wide"),
    ],
)
def test_light_that_cannot_be_precomputed_is_refused_by_its_reason(surface: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=f"light must be auto or sampled, got 'precomputed': .*{reason}"):
        mi.render(_scene("precomputed", surface, lamp=_lamp()), spp=1)


def test_light_is_not_precomputed_in_an_octahedron_with_smooth_shading(tmp_path: Path) -> None:
    shape = {"type": "ply", "filename": _mesh_ball(tmp_path, 2)}
    with pytest.raises(ValueError, match="normals of object 'object' are bent by 55 degrees on average, above 35"):
        mi.render(_scene("precomputed", MEDIUM, shape, lamp=_lamp()), spp=1)


@pytest.mark.parametrize("light", ["auto", "precomputed", "sampled"])
def test_path_traced_is_the_walk_with_the_light_that_is_asked_for(light: str) -> None:
    from full_geometry.scenes.scene_files import open_scene

    ball = {**_ball(), "bsdf": {"type": "translucent", **MEDIUM}}
    scene = {"type": "scene", "integrator": {"type": "bssrdf"}, "ball": ball, "light": {"type": "constant"}}
    integrator = open_scene(scene, "path_traced", settings={"light": light}).integrator()
    assert str(integrator).startswith("TranslucentWalk[") and integrator.light == light
    with pytest.raises(ValueError, match="light must be one of auto, precomputed, sampled, got 'gathered'"):
        open_scene(scene, "path_traced", settings={"light": "gathered"})


def test_a_light_that_does_not_exist_is_refused() -> None:
    with pytest.raises((ValueError, RuntimeError), match="light must be one of auto, precomputed, sampled, got 'grid'"):
        mi.load_dict({"type": "translucent_walk", "light": "grid"})


@pytest.mark.slow
def test_a_floor_has_the_light_of_a_delta_light_in_the_mirror_of_an_object() -> None:
    """A spot that shines on a cube alone: its mirror image is met by cones about the light, wide ones here."""
    T = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "component_format": "float32"}
    view = T.look_at([0, 6, 8], [0, -1, 1], [0, 1, 0])
    aim = T.look_at([0, 0.5, 5], [0, 0, 1], [0, 1, 0])
    floor = T.translate([0, -1.05, 0]).rotate([1, 0, 0], -90).scale(6)
    found, wanted = (
        independent(
            mi.load_dict(
                {
                    "type": "scene", "integrator": {"type": "translucent_walk", "light": how, "blur": 8.0},
                    "sensor": {"type": "perspective", "fov": 40.0, "to_world": view, "film": film},
                    "spot": {"type": "spot", "to_world": aim, "cutoff_angle": 12.0, "intensity": 100.0},
                    "floor": {"type": "rectangle", "to_world": floor, "bsdf": {"type": "diffuse", "reflectance": 0.8}},
                    "cube": {"type": "cube", "to_world": T.scale([3, 1, 1]),
                             "bsdf": {"type": "translucent", "sigma_s": 0.01, "sigma_a": 20.0, "eta": 3.0}},
                }
            ), 8, 1024, seed,
        )[..., 0].mean(axis=(1, 2))
        for how, seed in (("precomputed", 1), ("sampled", 101))
    )  # fmt: skip
    error = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (found, wanted)))
    assert abs(found.mean() - wanted.mean()) < WIDEST_Z * error < 0.5 * wanted.mean(), (found, wanted)
