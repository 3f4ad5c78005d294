"""Bodies that touch, and lamps on a surface: right at every gap that rays tell, else refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from full_geometry.geometry.shape import analyse_shape
from full_geometry.scenes.scene_files import open_scene

pytestmark = pytest.mark.usefixtures("rgb")


def _view(integrator: str, light: dict[str, Any], **things: dict[str, Any]) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    look = mi.ScalarTransform4f().look_at([3, -12, 6], [0, 0, 0], [0, 0, 1])
    camera = {"type": "perspective", "fov": 14, "to_world": look, "film": film}
    scene = {"type": "scene", "integrator": {"type": integrator}, "cam": camera, "light": light, **things}
    return mi.load_dict(scene, optimize=False)


def _box(low: tuple, high: tuple, **more: Any) -> dict[str, Any]:
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    half, middle = (0.5 * (high - low)).tolist(), (0.5 * (low + high)).tolist()
    return {"type": "cube", "to_world": mi.ScalarTransform4f().translate(middle).scale(half), **more}


def _wax(albedo: float, eta: float) -> dict[str, Any]:
    return {"type": "translucent", "sigma_t": "2", "albedo": str(albedo), "eta": eta, "model": "better_dipole"}


def _rendered(scene: mi.Scene, spp: int = 1) -> float:
    return float(np.array(scene.integrator().render(scene, seed=1, spp=spp)).mean())


def _two_blocks(gap: float, integrator: str = "translucent_walk", eta: float = 1.4) -> mi.Scene:
    return _view(integrator, {"type": "constant"}, one=_box((-2, -1, -1), (-gap / 2, 1, 1), bsdf=_wax(1.0, eta)),
                 two=_box((gap / 2, -1, -1), (2, 1, 1), bsdf=_wax(1.0, eta)))  # fmt: skip


@pytest.mark.parametrize("eta", [1.0, 1.4])
@pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-3, 1e-4, 5e-5, -1e-4])
def test_two_blocks_beside_each_other_are_white_in_a_furnace(gap: float, eta: float) -> None:
    assert abs(_rendered(_two_blocks(gap, eta=eta), 128) - 1) < 1e-3  # of which roulette leaves 2e-4


@pytest.mark.parametrize("gap", [1e-6, 0.0, -1e-6, -1e-5, -3e-3, -0.5])
@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_blocks_that_touch_or_have_sides_in_one_plane_are_refused_by_name(integrator: str, gap: float) -> None:
    with pytest.raises(ValueError, match="got the shape '(one|two)' .*object '(one|two)'"):
        _rendered(_two_blocks(gap, integrator))


@pytest.mark.parametrize("gap", [1e-6, 0.0, -1e-6, -1e-4, -3e-3, -0.5])
def test_pieces_of_one_mesh_that_touch_or_overlap_are_refused(gap: float) -> None:
    """Merged by Mitsuba: a furnace of them was 1.10 to 1.21."""
    blocks = {
        "one": _box((-2, -1, -1), (-gap / 2, 1, 1), bsdf=_wax(1.0, 1.4)),
        "two": _box((gap / 2, -1, -1), (2, 1, 1), bsdf=_wax(1.0, 1.4)),
    }
    (merged,) = mi.load_dict({"type": "scene", **blocks}).shapes()
    with pytest.raises(ValueError, match="pieces of object .* must not touch or overlap, got .* of the hits of rays"):
        analyse_shape(merged)


def test_pieces_of_one_mesh_that_are_apart_or_inside_each_other_are_not_refused() -> None:
    inner = _box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), bsdf=_wax(1.0, 1.4))
    outer = _box((-1, -1, -1), (1, 1, 1), bsdf=_wax(1.0, 1.4))
    beside = _box((1 + 1e-4, -1, -1), (2, 1, 1), bsdf=_wax(1.0, 1.4))
    (merged,) = mi.load_dict({"type": "scene", "outer": outer, "beside": beside}).shapes()
    assert analyse_shape(merged).closed
    (hollow,) = mi.load_dict({"type": "scene", "outer": outer, "inner": inner}).shapes()
    assert analyse_shape(hollow).closed


@pytest.mark.parametrize(
    ("integrator", "model", "apart"),
    [("translucent_walk", "better_dipole", 2), ("bssrdf", "neural_shape", 2), ("bssrdf", "better_dipole", 1)],
)
def test_meshes_of_one_surface_stay_apart_for_what_knows_whole_objects(
    integrator: str, model: str, apart: int, tmp_path: Path
) -> None:
    """By every way to load a scene; models of half-spaces tell pieces apart by themselves."""
    text = f"""<scene version="3.0.0"><integrator type="{integrator}"/>
      <bsdf type="translucent" id="wax"><string name="model" value="{model}"/><float name="sigma_t" value="20"/>
        <float name="albedo" value=".9"/></bsdf>
      <shape type="cube"><ref id="wax"/></shape>
      <shape type="cube"><ref id="wax"/><transform name="to_world"><translate x="4"/></transform></shape></scene>"""
    path = tmp_path / "two.xml"
    path.write_text(text)
    scenes = mi.load_string(text), mi.load_file(str(path)), open_scene(path)
    assert [len(scene.shapes()) for scene in scenes] == 3 * [apart]
    assert len(mi.load_string(text, optimize=True).shapes()) == 1


def test_glass_on_the_surface_of_an_object_is_refused_by_name() -> None:
    glass = _box((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5), bsdf={"type": "dielectric"})
    inner = _box((-1.5, -1, -1), (1, 1, 1), bsdf=_wax(0.9, 1.2))
    with pytest.raises(ValueError, match="apart by more than .*, got the shape 'glass' on the surface of object 'wax'"):
        _rendered(_view("translucent_walk", {"type": "constant"}, glass=glass, wax=inner))


def test_two_balls_that_meet_in_a_point_and_a_floor_below_are_not_refused() -> None:
    balls = {name: {"type": "sphere", "center": [x, 0, 0], "bsdf": _wax(1.0, 1.4)} for name, x in (("a", -1), ("b", 1))}
    floor = _box((-4, -4, -2), (4, 4, -1), bsdf={"type": "diffuse", "reflectance": 1.0})
    assert abs(_rendered(_view("translucent_walk", {"type": "constant"}, **balls), 128) - 1) < 1e-3
    assert _rendered(_view("translucent_walk", {"type": "constant"}, floor=floor, **balls), 1) > 0


def _lamp(gap: float, kind: str) -> dict[str, Any]:
    light, scale = {"type": "area", "radiance": 3.0}, mi.ScalarTransform4f().scale([0.6, 0.6, 1])
    if kind == "box":
        return _box((-0.6, -0.6, -1.4 - gap), (0.6, 0.6, -1 - gap), emitter=light)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -1 - gap]) @ scale,
        "emitter": light,
    }


def _lit(gap: float, kind: str, integrator: str = "translucent_walk") -> mi.Scene:
    block = _box((-1, -1, -1), (1, 1, 1), bsdf=_wax(0.95, 1.4))
    return _view(integrator, {"type": "constant", "radiance": 0.0}, block=block, lamp=_lamp(gap, kind))


@pytest.mark.slow
@pytest.mark.parametrize(("side", "kind"), [(1, "box"), (-1, "rectangle")], ids=["outside", "inside"])
def test_a_lamp_at_a_surface_is_as_bright_at_every_gap(side: int, kind: str) -> None:
    """On each side: inside no light is lost at the boundary. Most paths of a seed are the same."""
    known = _rendered(_lit(side * 1e-3, kind), 512)
    for gap in (1e-4, 5e-5):
        assert _rendered(_lit(side * gap, kind), 512) == pytest.approx(known, rel=0.02)


@pytest.mark.parametrize("gap", [1e-6, 0.0, -1e-6])
@pytest.mark.parametrize("kind", ["rectangle", "box"])
@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_a_lamp_on_the_surface_of_an_object_is_refused_by_name(integrator: str, kind: str, gap: float) -> None:
    with pytest.raises(
        ValueError, match="apart by more than .*, got the shape 'lamp' on the surface of object 'block'"
    ):
        _rendered(_lit(gap, kind, integrator))


@pytest.mark.parametrize("gap", [-1e-4, -1e-2])
def test_a_lamp_below_the_surface_is_refused_by_models(gap: float) -> None:
    with pytest.raises(ValueError, match="must be empty for .*, got the shape 'lamp' .*inside object 'block'"):
        _rendered(_lit(gap, "box", "bssrdf"))
