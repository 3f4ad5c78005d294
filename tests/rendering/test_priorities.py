"""Things that overlap: against `volpathmis` and walks on scenes that are built without an overlap, and in a furnace."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from test_inside import SKY, _agree, _ball, _means
from test_touching import _box

from benchmarks.mitsuba_media import VOLUME_PATH, medium
from full_geometry.walk import priorities

pytestmark = pytest.mark.usefixtures("rgb")

JELLY = {"type": "translucent", "sigma_t": "2,1,3", "albedo": ".9,.95,.7", "g": 0.3, "eta": 1.4}
CREAM = {"type": "translucent", "sigma_t": "1,2,2", "albedo": ".99,.8,.9", "g": 0.0, "eta": 1.2}
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}


def _view(things: dict, light: dict = SKY, integrator: dict | None = None) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    look = mi.ScalarTransform4f().look_at([3, -9, 5], [0, 0, 0], [0, 0, 1])
    camera = {"type": "perspective", "fov": 20, "to_world": look, "film": film}
    scene = {"type": "scene", "integrator": integrator or {"type": "translucent_walk"}, "cam": camera}
    return mi.load_dict({**scene, **light, **things}, optimize=False)


def _mesh(path: Path, *parts: tuple[np.ndarray, np.ndarray]) -> dict:
    """An OBJ file of vertices and faces."""
    lines, n = [], 1
    for v, f in parts:
        lines += [f"v {x} {y} {z}" for x, y, z in v] + ["f {} {} {}".format(*face) for face in f + n]
        n += len(v)
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path), "face_normals": True}


def _sides(low: tuple, high: tuple, without: str = "") -> tuple[np.ndarray, np.ndarray]:
    """A box without its bottom "-" or its top "+"."""
    v = np.array([(x, y, z) for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])])
    quads = {"-": (0, 2, 3, 1), "+": (4, 5, 7, 6), "a": (0, 1, 5, 4), "b": (2, 6, 7, 3), "c": (0, 4, 6, 2),
             "d": (1, 3, 7, 5)}  # fmt: skip
    return v, np.array(
        [part for key, (a, b, c, d) in quads.items() if key != without for part in ((a, b, c), (a, c, d))]
    )


def _square(half: float, z: float, hole: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square with its normal up, or a frame around a square hole."""
    v = np.array([(x * h, y * h, z) for h in (half, hole) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    if not hole:
        return v[:4], np.array([(0, 1, 2), (0, 2, 3)])
    return v, np.array([f for k in range(4) for j in [(k + 1) % 4] for f in ((k, j, 4 + j), (k, 4 + j, 4 + k))])


def _between(inside: float, outside: float, alpha: float | None = None) -> dict:
    kind = {"type": "dielectric"} if alpha is None else {"type": "roughdielectric", "alpha": alpha}
    return {**kind, "int_ior": inside, "ext_ior": outside}


def _filled(bsdf: dict) -> dict:
    return {"interior": medium(mi.load_dict(bsdf).spec, 1.0)}


def _sunk(folder: Path) -> tuple[dict, dict]:
    """A frosted block of jelly sunk into a floor of cream."""
    frosted = {**JELLY, "b": _between(1.4, 1.0, 0.3)}
    block, floor = ((-0.5, -0.5, -0.4), (0.5, 0.5, 1)), ((-1.2, -1.2, -1), (1.2, 1.2, 0))
    ours = {"block": _box(*block, bsdf=frosted), "floor": _box(*floor, bsdf={**CREAM, "priority": 1})}
    above, below = ((-0.5, -0.5, 0), block[1]), floor
    return ours, {
        "above": {**_mesh(folder / "a", _sides(*above, "-")), "bsdf": _between(1.4, 1.0, 0.3), **_filled(JELLY)},
        "below": {**_mesh(folder / "b", _sides(*below, "+"), _square(1.2, 0, 0.5)), "bsdf": _between(1.2, 1.0),
                  **_filled(CREAM)},
        "shared": {**_mesh(folder / "s", _square(0.5, 0)), "bsdf": _between(1.2, 1.4), **_filled(CREAM),
                   "exterior": _filled(JELLY)["interior"]},
    }  # fmt: skip


def _poured(folder: Path, priority: float) -> tuple[dict, dict]:
    """A liquid in closed glass, whose walls it overlaps."""
    liquid, wall = {**JELLY, "eta": 1.33}, 0.8 if priority < 0 else 0.9
    v, faces = _sides((-0.8, -0.8, -0.8), (0.8, 0.8, 1))
    outer, cavity = _sides((-1, -1, -1), (1, 1, 1.2)), (v, faces[:, ::-1])
    ours = {"glass": {**_mesh(folder / "g", outer, cavity), "bsdf": GLASS},
            "liquid": _box((-0.9,) * 3, (0.9, 0.9, 0.3), bsdf={**liquid, "priority": priority})}  # fmt: skip
    beside_glass = [_sides((-wall,) * 3, (wall, wall, 0.3), "+")] + [_square(0.9, 0.3, 0.8)] * (priority > 0)
    return ours, {
        "glass": {**_mesh(folder / "o", outer), "bsdf": GLASS},
        "liquid": {**_mesh(folder / "l", *beside_glass), "bsdf": _between(1.33, 1.5), **_filled(liquid)},
        "top": {**_mesh(folder / "t", _square(0.8, 0.3)), "bsdf": _between(1.33, 1.0), **_filled(liquid)},
        "air": {**_mesh(folder / "a", _sides((-0.8, -0.8, 0.3), (0.8, 0.8, 1), "-")), "bsdf": _between(1.0, 1.5)},
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "built",
    [_sunk, lambda path: _poured(path, -1.0), lambda path: _poured(path, 1.0)],
    ids=["floor", "glass", "liquid"],
)
def test_overlaps_are_seen_as_by_the_volume_path_tracer_where_none_is(built: Callable, tmp_path: Path) -> None:
    ours, theirs = built(tmp_path)
    _agree(_means(_view(ours), 512, 1), _means(_view(theirs, integrator=VOLUME_PATH), 512, 101), 0.004)


def _cone(left: float, right: float) -> tuple[np.ndarray, np.ndarray]:
    """A double cone about a circle at x = 0."""
    angle, i = np.arange(16) * np.pi / 8, np.arange(16)
    v = np.concatenate([np.stack([0 * angle, np.cos(angle), np.sin(angle)], 1), [[left, 0, 0], [right, 0, 0]]])
    j = np.roll(i, -1)
    return v, np.concatenate([np.stack([j, i, 0 * i + 16], 1), np.stack([i, j, 0 * i + 17], 1)])


def test_two_objects_of_one_medium_are_as_their_union(tmp_path: Path) -> None:
    cones = {"one": (-1.5, 0.8), "two": (-0.8, 1.5), "both": (-1.5, 1.5)}
    one, two, both = ({**_mesh(tmp_path / key, _cone(*ends)), "bsdf": JELLY} for key, ends in cones.items())
    _agree(_means(_view({"a": one, "b": two}), 512, 1), _means(_view({"a": both}), 512, 101), 0.004)


def _copies(*places: float, bsdf: dict = CREAM) -> dict:
    """Instances of a ball."""
    things = {"group": {"type": "shapegroup", "part": _ball(0.4, bsdf=bsdf)}}
    for k, x in enumerate(places):
        at = mi.ScalarTransform4f().translate([x, 0.2, 0.3])
        things[f"copy{k}"] = {"type": "instance", "to_world": at, "of": {"type": "ref", "id": "group"}}
    return things


@pytest.mark.slow
def test_an_even_sky_stays_even_over_overlaps_that_absorb_nothing() -> None:
    """A ball in a block that holds a bubble and overlaps glass, all around a white stone, and two instances."""
    white = {**JELLY, "sigma_t": "2", "albedo": "1"}
    frosted = {**white, "eta": 1.2, "priority": 2, "b": _between(1.2, 1.0, 0.03)}
    things = {
        "ball": _ball(1.0, (-0.5, 0, 0), bsdf=white),
        "block": _box((-1, -1, -1), (1, 1, 0), bsdf=frosted),
        "bubble": _ball(0.3, (0.3, 0.4, -0.5), bsdf=_between(1.0, 1.2)),
        "glass": _ball(0.8, (0, -0.7, 0.3), bsdf=GLASS),
        "stone": _ball(0.5, (0, -0.4, 0.2), bsdf={"type": "diffuse", "reflectance": 1.0}),
        **_copies(0.9, 1.2, bsdf=white),
    }
    found = np.array(mi.render(_view(things), spp=512, seed=1))
    assert abs(found.mean() - 1) < 5e-4


@pytest.mark.slow
@pytest.mark.parametrize("light", ["precomputed", "sampled"])
def test_an_object_whose_normals_point_inwards_looks_the_same_beside_an_overlap(light: str) -> None:
    def image(**turned: bool) -> np.ndarray:
        things = {"a": _ball(0.5, (-0.3, 0, 0.5), bsdf=CREAM), "b": _ball(0.5, (0.1, 0, 0.5), bsdf=JELLY)}
        things["beside"] = {**_ball(0.8, (0, 0, -0.9), bsdf=CREAM), **turned}
        return np.array(
            mi.render(_view(things, integrator={"type": "translucent_walk", "light": light}), spp=64, seed=1)
        )

    np.testing.assert_allclose(image(flip_normals=True).mean(), image().mean(), rtol=0.02)


def test_the_later_of_equal_priorities_wins() -> None:
    def image(**first: float) -> np.ndarray:
        things = {"a": _ball(1.0, (-0.5, 0, 0), bsdf={**JELLY, **first}), "b": _ball(1.0, (0.5, 0, 0), bsdf=CREAM)}
        return np.array(mi.render(_view(things), spp=4, seed=1))

    np.testing.assert_array_equal(image(), image(priority=-1.0))
    assert np.abs(image() - image(priority=1.0)).max() > 0.01


def test_a_priority_of_an_object_inside_another_gives_its_index_another_meaning_and_no_more() -> None:
    def image(**seed: float) -> np.ndarray:
        seeds = {"wax": _ball(1.0, bsdf=JELLY), "seed": _ball(0.6, (0.1, 0, 0.2), bsdf={**CREAM, **seed})}
        return np.array(mi.render(_view(seeds), spp=16, seed=1))

    np.testing.assert_allclose(image(eta=1.2), image(eta=1.2 * 1.4, priority=1.0), rtol=1e-5)


def test_an_edit_of_the_index_of_glass_over_an_object_is_seen() -> None:
    def scene(index: float) -> mi.Scene:
        glass = _box((-2, -2, -2), (2, 2, 0), bsdf={**GLASS, "int_ior": index})
        return _view({"wax": _ball(1.0, bsdf={**CREAM, "priority": -1.0}), "glass": glass})

    edited = scene(1.5)
    before = np.array(mi.render(edited, spp=16, seed=1))
    parameters = mi.traverse(edited)
    parameters["glass.bsdf.eta"] = 1.2
    parameters.update()
    after = np.array(mi.render(edited, spp=16, seed=1))
    np.testing.assert_allclose(after, np.array(mi.render(scene(1.2), spp=16, seed=1)), rtol=1e-4)
    assert np.abs(after - before).max() > 0.01


def test_a_camera_that_moves_into_a_bell_jar_sees_its_glass() -> None:
    """What is in a jar is known by the glass that rays have passed, so that none may begin in there."""
    jar = {"jar": _ball(2.0, bsdf=GLASS), "hollow": _ball(1.9, bsdf=_between(1.5, 1.0)), "wax": _ball(0.5, bsdf=CREAM)}
    inside = mi.ScalarTransform4f().look_at([0, -1.5, 0], [0, 1, 0.9], [0, 0, 1])
    moved, fresh = (_view(jar) for _ in range(2))
    mi.render(moved, spp=1)
    for scene in (moved, fresh):
        parameters = mi.traverse(scene)
        parameters["cam.to_world"] = inside
        parameters.update()
    np.testing.assert_allclose(*(np.array(mi.render(scene, spp=4, seed=1)) for scene in (moved, fresh)), rtol=1e-4)


POINT = {"lamp": {"type": "point", "position": [0.7, 0, 0]}}
COATED = {"type": "principled", "spec_trans": 1.0}


@pytest.mark.parametrize(
    ("of", "wanted"),
    [
        (lambda: {"b": _ball(1.0, (0.5, 0, 0), bsdf=CREAM), **POINT}, "delta light must not stand .* got .*'lamp' in"),
        (lambda: {"b": _ball(1.0, (0.5, 0, 0), bsdf=COATED)}, "must be a dielectric or .* got the Principled of .*'b'"),
        (lambda: _copies(0.3, 0.5), "at most 2 refracting shapes may overlap .* got 3"),
        (lambda: {"b": {"type": "cylinder", "p1": [4, 0, 0], "radius": 0.4, "bsdf": CREAM}}, "be closed, got .* 'b'"),
        (lambda: {"b": _ball(1.0, (-0.5, 0, 0), bsdf=CREAM)}, "surfaces must be apart by more than .* got the shape"),
    ],
    ids=["delta light", "principled", "too many", "open", "coplanar"],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:object .* is not closed")
def test_overlaps_that_cannot_be_known_are_refused_by_name(
    of: Callable[[], dict[str, Any]], wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(priorities, "MOST", 2)
    scene = _view({"a": _ball(1.0, (-0.5, 0, 0), bsdf=JELLY), **of()}, {})
    with pytest.raises(ValueError, match=wanted):
        scene.integrator().render(scene, spp=1)


def test_models_refuse_what_overlaps() -> None:
    things = {"a": _ball(1.0, (-0.5, 0, 0), bsdf=JELLY), "b": _ball(1.0, (0.5, 0, 0), bsdf=CREAM)}
    scene = _view(things, integrator={"type": "bssrdf"})
    with pytest.raises(ValueError, match="must be empty for .* partly inside .* the integrator translucent_walk"):
        scene.integrator().render(scene, spp=1)


def test_corrected_light_refuses_objects_that_glass_hides() -> None:
    things = {"glass": _ball(1.0, bsdf=GLASS), "wax": _ball(0.5, bsdf={**CREAM, "priority": -1.0})}
    scene = _view(things, integrator={"type": "bssrdf", "light": "corrected"})
    with pytest.raises(ValueError, match="must be sampled for object 'wax', of which nothing is outside of other"):
        scene.integrator().render(scene, spp=1)


def test_a_priority_is_a_finite_number() -> None:
    with pytest.raises(RuntimeError, match="priority must be finite, got inf"):
        mi.load_dict({**JELLY, "priority": float("inf")})
