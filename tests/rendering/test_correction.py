"""Gathered light corrected by walks: the regression over a surface, means against walks, what is kept, refusals."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from full_geometry.geometry.light_points import lattice
from full_geometry.integrators import correction
from full_geometry.integrators.correction import PER_LAUNCH, ROOTS, Corrections
from full_geometry.precomputed.surface_regression import TERMS, ResidualSums, directional, levels, smooth_field
from full_geometry.scenes import reference

pytestmark = pytest.mark.usefixtures("rgb")

dr, mi = pytest.importorskip("drjit"), pytest.importorskip("mitsuba")

MEDIUM = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}
WHITE = {"sigma_s": "1,1.5,2", "sigma_a": 0.0, "eta": 1.4}


# ---- The regression --------------------------------------------------------------------------------------------------

RADIUS = 0.03  # of a rod of length 1


def _sphere(count: int) -> np.ndarray:
    k = np.arange(count)
    z, phi = 1 - 2 * (k * 0.6180339887 % 1), 2 * np.pi * (k * 0.7548776662 % 1)
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z])


def _rod(z: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of a rod about the z axis, and their normals."""
    n = np.column_stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)])
    return np.column_stack([RADIUS * n[:, :2], z]), n


def _regression(residuals: int, seed: int = 0) -> tuple[float, float, float]:
    """RMS error of a known field on a sphere by noisy residuals, what is told, and the mean error along normals.

    All are over the RMS of the field.
    """
    rng, p = np.random.default_rng(seed), _sphere(2048)
    G = np.where(p[:, 0] > 0.2, 1.0, 0.2)
    constant = (0.3 + 0.2 * p[:, 2] + 0.5 * G + 0.1 * np.sin(4 * p[:, 1]))[:, None] * np.array([1.0, 0.8, 0.5])
    halves = []
    for _ in range(2):
        point, w = rng.integers(0, len(p), residuals // 2), rng.normal(size=(residuals // 2, 3))
        w *= (np.sign((w * p[point]).sum(axis=1)) / np.linalg.norm(w, axis=1))[:, None]
        a = np.repeat(0.5 + 0.5 * (w * p[point]).sum(axis=1, keepdims=True), 3, axis=1)
        Y = np.stack(directional(*w.T, 0.7 + 0.3 * (w * p[point]).sum(axis=1)), axis=1)
        r = a * (constant[point] + 0.1 * w[:, :1] + 0.2 * Y[:, -1:]) * rng.exponential(size=(residuals // 2, 1))
        halves.append(ResidualSums.of(point, Y, a, r, len(p)))
    C, _, squared = smooth_field(levels(p, p, 4 * np.pi, residuals), p, G, (halves[0], halves[1]))
    a = halves[0].a + halves[1].a
    Y = a[:, 0] / a[:, :1, 0]
    wanted = constant + 0.1 * Y[:, 1:2] + 0.2 * Y[:, -1:]
    found = (C * Y[:, None, :]).sum(axis=2)
    whole = np.square(wanted).sum(axis=1).mean()
    along = np.stack(directional(*p.T, np.ones(len(p))), axis=1)
    bias = ((C * along[:, None, :]).sum(axis=2) - constant - 0.1 * p[:, :1] - 0.2).mean() / np.sqrt(whole / 3)
    return np.sqrt(np.square(found - wanted).sum(axis=1).mean() / whole), np.sqrt(squared.mean() / whole), bias


@pytest.mark.slow
def test_the_error_of_a_field_falls_with_the_residuals_and_is_told_within_a_factor_of_two() -> None:
    errors = [_regression(n) for n in (2**14, 2**17, 2**20)]
    found, told, along_normals = np.array(errors).T
    assert (found[1:] < found[:-1] / 1.25).all()
    assert np.abs(along_normals[-1]) < 0.01
    assert found[-1] < 0.03
    assert ((told / found > 0.5) & (told / found < 2)).all()


def test_a_slope_over_the_cosine_is_found_on_a_rod_whose_normals_turn_within_the_reach_of_fits() -> None:
    rng, k = np.random.default_rng(3), np.arange(1024)
    p, n = _rod(k * 0.7548776662 % 1 - 0.5, 2 * np.pi * (k * 0.6180339887 % 1))
    slope, halves = np.sin(6 * p[:, 2:]), []
    for _ in range(2):
        point, u = rng.integers(0, 1024, 2**16), rng.normal(size=(2**16, 3))
        w = n[point] + 0.7 * u / np.linalg.norm(u, axis=1)[:, None]
        w /= np.linalg.norm(w, axis=1)[:, None]
        Y = np.stack(directional(*w.T, (w * n[point]).sum(axis=1)), axis=1)
        r = (1 + slope[point] * Y[:, 9:10]) * np.ones(3)
        halves.append(ResidualSums.of(point, Y, np.ones_like(r), r, 1024))
    C, _, _ = smooth_field(levels(p, n, 2 * np.pi * RADIUS, 2**17), p, 0 * k, (halves[0], halves[1]))
    along = np.stack(directional(*n.T, np.ones(1024)), axis=1)
    assert np.sqrt(np.square((C * along[:, None, :]).sum(axis=2) - 1 - slope).mean()) < 0.1


def test_places_and_directions_of_walks_are_even_in_each_pair_of_dimensions() -> None:
    u = np.array(lattice(PER_LAUNCH, ROOTS, [0.5] * 5))
    for i, j in itertools.combinations(range(5), 2):
        counts = np.histogram2d(u[i], u[j], 16, ((0, 1), (0, 1)))[0]
        assert np.abs(counts / counts.mean() - 1).max() < 0.2, (i, j)


def test_sums_of_two_sets_of_residuals_are_those_of_both() -> None:
    rng = np.random.default_rng(1)
    point, Y, a, r = rng.integers(0, 5, 60), rng.normal(size=(60, 4)), rng.random((60, 3)) + 0.1, rng.random((60, 3))
    parts = [ResidualSums.of(point[s], Y[s], a[s], r[s], 5) for s in (slice(0, 40), slice(40, 60), slice(0, 60))]
    both, whole = parts[0] + parts[1], parts[2]
    for x, y in ((both.number, whole.number), (both.a, whole.a), (both.r, whole.r)):
        np.testing.assert_allclose(x, y, rtol=1e-12)


# ---- Light -----------------------------------------------------------------------------------------------------------


def _scene(light: str, surface: dict, lights: dict, model: str = "better_dipole", hidden: bool = True) -> Any:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    walks = light in ("precomputed", "walk")
    own = {"type": "translucent_walk"} if walks else {"type": "bssrdf", "light": light, "max_depth": -1}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"mm_per_unit": 6.0, "hide_emitters": hidden, **own},
            "sensor": {"type": "perspective", "fov": 14.0, "to_world": view, "film": film},
            "wax": {
                "type": "sphere",
                "bsdf": {"type": "translucent", **({} if "type" in surface else {"model": model}), **surface},
            },
            **lights,
        }
    )


def _lamp() -> dict:
    to_world = mi.ScalarTransform4f().look_at([3, 3, 3], [0, 0, 0], [0, 1, 0]).scale(1.5)
    lamp = {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": 5.0}}
    return {"lamp": lamp, "sky": {"type": "constant", "radiance": 0.3}}


def _image(scene: Any, spp: int = 64, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, spp=spp, seed=seed), dtype=float)


class _Left(Corrections):
    """Leaves gathered light as it is."""

    def of(self, scene: Any, objects: list, settings: Any, samples: int) -> list:
        return None


def _with(scene: Any, corrections: Corrections) -> Any:
    """The scene, whose light is not gathered again."""
    scene.integrator().corrections = corrections
    return scene


@pytest.fixture(scope="module")
def gathered_once() -> Any:
    return _scene("corrected", MEDIUM, _lamp())


@pytest.fixture
def scene(gathered_once: Any) -> Any:
    """Of a lamp and a sky, not corrected yet."""
    return _with(gathered_once, Corrections())


@pytest.mark.slow
def test_a_medium_without_absorption_is_invisible_in_uniform_light() -> None:
    """All walks bring 1, what the model lacks is corrected whole."""
    scene = _scene("corrected", WHITE, {"sky": {"type": "constant"}}, hidden=False)
    gathered = _image(_with(scene, _Left()), 64)
    _with(scene, Corrections()).integrator().prepare(scene, 2**22)
    corrected = _image(scene, 256)
    assert np.abs(gathered - 1).max() > 0.1
    assert np.abs(corrected.mean(axis=(0, 1)) - 1).max() < 0.005
    assert np.abs(corrected - 1).max() < 0.03


@pytest.mark.slow
def test_light_through_a_rough_boundary_is_that_of_walks_along_it_too() -> None:
    frosted = {**MEDIUM, "b": {"type": "roughdielectric", "alpha": 0.4, "int_ior": 1.4, "ext_ior": 1.0}}
    walked, rough = (_finer(_scene(light, frosted, _lamp())) for light in ("precomputed", "corrected"))
    walks = np.array([_image(walked, 256, seed) for seed in (1, 2)]).mean(axis=-1)
    corrected = np.array([_image(_with(rough, Corrections(part)), 64) for part in range(4)]).mean(axis=-1)
    assert "corrected by 131072 walks" in rough.integrator().gathered[0]
    # means are known to .6 %; along the boundary F_t of a smooth one leaves 5 %
    assert abs(corrected.mean() / walks.mean() - 1) < 0.02
    y, x = np.mgrid[-11.5:12, -11.5:12]
    rim = np.abs(np.hypot(x, y) / 12 - 0.98) < 0.026  # where the cosine is .2 to .37
    assert abs(corrected[:, rim].mean() / walks[:, rim].mean() - 1) < 0.035


def _finer(scene: Any) -> Any:
    parameters = mi.traverse(scene)
    parameters["sensor.film.size"] = [24, 24]
    parameters.update()
    return scene


def _painted() -> dict:
    """Tiles of two colours, of which one sends back thirty times what the other does."""
    colours = [{"type": "rgb", "value": value} for value in ([0.95, 0.4, 0.6], [0.3, 0.9, 0.8])]
    tiles = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([6, 4, 1])}
    return {"sigma_t": "1.2,1.4,1.1", "albedo": {**tiles, "color0": colours[0], "color1": colours[1]}, "eta": 1.4}


def _forward() -> dict:
    """Deep light that is narrow, as no boundary bends it and much is absorbed before it turns."""
    return {"sigma_t": 5.0, "albedo": 0.9, "g": 0.8, "eta": 1.0}


@pytest.mark.slow
@pytest.mark.parametrize("medium", [_painted, _forward])
def test_its_pixels_are_those_of_walks_within_5_percent_where_tiles_or_views_change_light(medium: Any) -> None:
    walked = _image(_scene("precomputed", medium(), _lamp()), 4096)
    found = _image(_with(_scene("corrected", medium(), _lamp()), Corrections()), 512)
    off = np.sqrt(np.square(found - walked).sum(axis=(0, 1)) / np.square(walked).sum(axis=(0, 1)))
    assert (off < 0.05).all(), off
    assert np.abs(found.mean(axis=(0, 1)) / walked.mean(axis=(0, 1)) - 1).max() < 0.025


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth of the walks and of the light inside."""
    for name in ("PER_LAUNCH", "FEWEST", "FEWEST_OF_LIGHT"):
        monkeypatch.setattr(correction, name, getattr(correction, name) // 8)


@pytest.mark.slow
def test_its_layer_of_emission_is_that_of_walks(little_light: None) -> None:
    """The sky beside a ball and in its mirror; without it, the image is as without layers."""
    scene, images = _scene("walk", MEDIUM, _lamp(), hidden=False), []
    for plugin in ("translucent_walk", "bssrdf"):
        light = {"light": "corrected"} if plugin == "bssrdf" else {}
        for layers in (True, False):
            integrator = mi.load_dict({"type": plugin, "mm_per_unit": 6.0, "layers": layers, **light})
            images.append(np.array(mi.render(scene, integrator=integrator, spp=64), dtype=float))
    walked, _, layered, alone = images
    np.testing.assert_allclose(layered[..., :3], alone, rtol=1e-5)
    assert layered[..., 3:].mean() > 0.1 * alone.mean()
    np.testing.assert_allclose(layered[..., 3:], walked[..., 3:], rtol=1e-5)


@pytest.mark.slow
def test_its_error_in_an_image_is_that_of_the_part_that_is_no_emission(little_light: None, tmp_path: Path) -> None:
    scene, found = _scene("walk", MEDIUM, _lamp(), hidden=False), {}
    for layers in (True, False):
        integrator = {"type": "bssrdf", "mm_per_unit": 6.0, "light": "corrected", "layers": layers}
        found[layers] = reference.render(scene, tmp_path / f"{layers}.exr", integrator=integrator, spp=16)
    L, L_e = found[True].mean[..., :3], found[True].mean[..., 3:]
    share = np.sqrt(np.square(L - L_e).sum() / np.square(L).sum())
    assert share < 0.9
    assert found[True].light_error == pytest.approx(share * found[False].light_error, rel=0.02)


@pytest.mark.slow
def test_a_medium_that_is_black_in_two_channels_has_the_light_of_walks_in_the_other(few: None) -> None:
    red = {"sigma_t": 1.2, "albedo": "0.9,0,0", "eta": 1.4}
    walked, found = (_image(_scene(light, red, _lamp()), 256).mean(axis=(0, 1)) for light in ("walk", "corrected"))
    np.testing.assert_allclose(found, walked, rtol=0.05)


@pytest.mark.slow
def test_walks_are_added_for_an_image_of_more_samples_and_kept_for_one_of_fewer(scene: Any, few: None) -> None:
    walks = []
    for spp in (16, 2**11, 16):
        scene.integrator().prepare(scene, 144 * spp)
        (told,) = scene.integrator().corrections.told()
        walks.append(int(told.split("corrected by ")[1].split()[0]))
    assert walks[0] == correction.FEWEST
    assert walks[1] == walks[2] == pytest.approx(144 * 2**11 / 8, rel=0.3)


@pytest.mark.slow
def test_a_render_in_passes_has_walks_by_all_its_samples(
    scene: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PER_LAUNCH", "FEWEST", "FEWEST_OF_LIGHT"):
        monkeypatch.setattr(correction, name, getattr(correction, name) // 32)
    reference.render(scene, tmp_path / "image.exr", spp=512)
    (told,) = scene.integrator().corrections.told()
    assert int(told.split("corrected by ")[1].split()[0]) > 1.5 * correction.FEWEST


@pytest.mark.slow
def test_a_render_to_an_error_has_walks_until_light_takes_at_most_half_of_its_square(
    scene: Any, few: None, tmp_path: Path
) -> None:
    found = reference.render(scene, tmp_path / "image.exr", target_error=0.06)
    assert found.error <= 0.06
    assert 0 < scene.integrator().corrections.error <= 0.06 / 2**0.5
    assert scene.integrator().corrections.samples > 144 * found.spp


def test_a_render_to_an_error_below_that_of_most_walks_ends_when_its_noise_is_below(
    scene: Any, few: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(correction, "MOST", correction.FEWEST)
    found = reference.render(scene, tmp_path / "image.exr", target_error=0.04)
    assert found.noise <= 0.04 < found.error


def test_walks_that_are_added_have_seeds_of_their_own_however_many_were_lost(
    scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = []

    def nothing(*arguments: Any) -> list[ResidualSums]:
        seeds.append(arguments[-1])
        points, ones = len(arguments[2].points), np.ones((9, 3))
        return [ResidualSums.of(np.zeros(9, int), np.ones((9, TERMS)), ones, ones, points)]

    monkeypatch.setattr(correction, "residuals", nothing)
    for spp, launches in ((16, 2), (16, 2), (2**14, 4), (2**14, 4), (2**15, 8)):
        scene.integrator().prepare(scene, 144 * spp)
        assert len(seeds) == len(set(seeds)) == launches


def test_the_same_seed_gives_the_same_image(scene: Any, few: None) -> None:
    one, two = (_image(_with(scene, Corrections()), 16, 7) for _ in range(2))
    np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_light_is_corrected_anew_when_an_emitter_was_edited(scene: Any, few: None) -> None:
    before = _image(scene, 16)
    parameters = mi.traverse(scene)
    parameters["lamp.emitter.radiance.value"] = 0.0
    parameters.update()
    preview = np.array(scene.integrator().preview(scene, scene.sensors()[0], 0, 16))
    assert scene.integrator().corrections.told() == [] and preview.mean() < 0.7 * before.mean()
    after = _image(scene, 16)
    dark = _lamp()
    dark["lamp"]["emitter"]["radiance"] = 0.0
    fresh = _image(_scene("corrected", MEDIUM, dark), 16)
    assert after.mean() < 0.7 * before.mean()
    np.testing.assert_allclose(after.mean(axis=(0, 1)), fresh.mean(axis=(0, 1)), rtol=0.01)


def test_a_diffuse_surface_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="light of object 'wax' must be sampled, got corrected: it leaves"):
        _image(_scene("corrected", MEDIUM, _lamp(), "lambert"))


def _in_light(integrator: str) -> Any:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    own = {"type": "bssrdf", "light": "corrected"} if integrator == "bssrdf" else {"type": integrator}
    sensor = {"type": "perspective", "fov": 22.0, "to_world": view, "film": film}
    own |= {"mm_per_unit": 3.0, "hide_emitters": True}
    return mi.load_dict({"type": "scene", "integrator": own, "sensor": sensor, **_things(), **_lamp()})


def _ball(x: float, y: float, radius: float, bsdf: dict) -> dict:
    return {"type": "sphere", "center": [x, y, 0], "radius": radius, "bsdf": bsdf}


def _things() -> dict:
    """Two objects that overlap, one with a stone; below one with a normal map, one with a mask and an instance."""
    at, wax = mi.ScalarTransform4f(), {"type": "translucent", "model": "better_dipole", **MEDIUM}
    soap = {"type": "translucent", "sigma_s": "3,3,1", "sigma_a": ".1,.2,.3", "eta": 1.3}
    normals = np.zeros((16, 32, 3), np.float32)
    normals[..., 0], normals[..., 2] = 0.4 * np.sin(np.arange(32)), 0.9
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(0.5 * normals + 0.5), "raw": True}
    opacity = {"type": "checkerboard", "color0": 0.3, "color1": 1.0}
    place = at.translate([1.0, -0.7, 0]).scale([0.7, 1.2, 0.8])
    return {
        "one": _ball(-0.4, 0.6, 0.6, wax), "stone": _ball(-0.5, 0.6, 0.3, {"type": "diffuse", "reflectance": 0.2}),
        "other": _ball(0.4, 0.6, 0.6, soap),
        "bent": _ball(-0.95, -0.7, 0.45, {"type": "normalmap", "normalmap": bitmap, "bsdf": wax}),
        "thin": _ball(0.05, -0.7, 0.45, {"type": "mask", "opacity": opacity, "bsdf": wax}),
        "group": {"type": "shapegroup", "id": "group", "wax": _ball(0, 0, 0.5, wax)},
        "shown": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place},
    }  # fmt: skip


@pytest.mark.slow
def test_it_takes_what_walks_take_and_has_their_means_within_1_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PER_LAUNCH", "FEWEST", "FEWEST_OF_LIGHT"):  # the noise of four is held below
        monkeypatch.setattr(correction, name, getattr(correction, name) // 4)
    scene, walked = _in_light("bssrdf"), _in_light("translucent_walk")
    found, means = [], [_image(walked, 512, seed).reshape(2, 8, 2, 8, 3).mean(axis=(1, 3)) for seed in range(4)]
    for part in range(4):
        scene.integrator().corrections = Corrections(part)
        found.append(_image(scene, 64, part).reshape(2, 8, 2, 8, 3).mean(axis=(1, 3)))
    for of in (lambda x: np.array(x).mean(axis=(1, 2)), np.array):  # the image, then quarters of it
        (a, da), (b, db) = ((of(x).mean(axis=0), of(x).std(axis=0, ddof=1) / 2) for x in (found, means))
        noise, off = np.hypot(da, db) / b, np.abs(a / b - 1)
        typical = np.sqrt(np.square(noise).mean())  # four images tell the noise of one quarter within 40 % alone
        assert typical < 0.03 and (off < 0.01 + 4 * np.maximum(noise, typical)).all(), (a / b, noise)
    assert len(scene.integrator().gathered) == 5


@pytest.mark.slow
def test_light_that_a_floor_mirrors_onto_a_wall_is_known_where_it_scatters_first() -> None:
    """A tenth of the light of the dark channel; the medium is even in direction, so that all light is in the cells."""
    wax = {"type": "translucent", "sigma_s": ".3,.6,.9", "sigma_a": ".7,.4,.1", "eta": 1.6, "model": "better_dipole"}
    T = mi.ScalarTransform4f
    to_lamp, to_camera = T().look_at([40, 8, 0], [-5, 1, 0], [0, 1, 0]), T().look_at([10, 6, 12], [-5, 2, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 25.0, "to_world": to_camera, "film": film},
        "floor": {"type": "cube", "to_world": T().translate([0, -1, 0]).scale([5, 1, 5]), "bsdf": wax},
        "wall": {"type": "cube", "to_world": T().translate([-6.5, 3, 0]).scale([1, 4, 5]), "bsdf": wax},
        "lamp": {"type": "rectangle", "to_world": to_lamp.scale(2), "emitter": {"type": "area", "radiance": 300.0}},
    }
    walked, corrected = (
        _image(mi.load_dict({**scene, "integrator": each}), spp).mean(axis=(0, 1))
        for each, spp in (({"type": "translucent_walk"}, 1024), ({"type": "bssrdf", "light": "corrected"}, 64))
    )
    np.testing.assert_allclose(corrected, walked, rtol=0.025)


@pytest.mark.slow
def test_light_toward_a_ball_in_a_clear_one_is_that_of_walks_within_two_and_a_half_percent() -> None:
    """The image of the ball has an edge, which no smooth function of directions follows: 4 % in red if they had to."""
    clear = {"sigma_t": ".233,.267,.283", "albedo": ".98,.5,.4", "eta": 1.0}
    cream = {
        "type": "sphere",
        "radius": 0.3,
        "bsdf": {"type": "translucent", "sigma_t": 6.7, "albedo": 0.99, "eta": 1.0},
    }
    lamp = {"type": "sphere", "center": [-4.5, 5, -3], "radius": 2.25, "emitter": {"type": "area", "radiance": 25.0}}
    shown = {"cream": cream, "lamp": lamp, "sky": {"type": "constant", "radiance": 0.5}}
    walked, corrected = (
        np.mean([_image(_scene(light, clear, shown), spp, k)[4:8, 4:8] for k in range(n)], axis=(0, 1, 2))
        for light, spp, n in (("walk", 2048, 4), ("corrected", 512, 1))
    )
    np.testing.assert_allclose(corrected, walked, rtol=0.025)


@pytest.mark.slow
def test_light_of_a_ball_in_glass_and_of_one_in_a_bell_jar_is_that_of_walks_within_four_percent() -> None:
    wax = {"type": "translucent", "sigma_t": 8.0, "albedo": ".95,.9,.6", "eta": 1.4}
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    hollow = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}
    shown = {"glass": _ball(-0.5, 0, 0.48, glass), "jar": _ball(0.5, 0, 0.48, glass)}
    shown |= {"wax": _ball(-0.5, 0, 0.3, wax), "other": _ball(0.5, 0, 0.3, wax), "hollow": _ball(0.5, 0, 0.4, hollow)}
    walked, corrected = (
        _image(_scene(light, wax, {**shown, **_lamp()}), spp) for light, spp in (("walk", 1024), ("corrected", 256))
    )
    halves = (image.reshape(12, 2, 6, 3).mean(axis=(0, 2)) for image in (corrected, walked))
    np.testing.assert_allclose(*halves, rtol=0.04)  # one correction is known to 1 %
