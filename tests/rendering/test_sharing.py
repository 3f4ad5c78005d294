"""Scenes of single objects beside that of the user: names, and rays that are tried in one kernel."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import render, surface

mi = pytest.importorskip("mitsuba")

from full_geometry.geometry import shape as sharing  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")


@pytest.fixture
def by_optix(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where scenes share a table of shaders; LLVM takes a scene that is given to another and has no use for it."""
    monkeypatch.setattr(sharing, "_by_optix", lambda: True)


def scene() -> dict:
    view = mi.ScalarTransform4f().look_at([0, 0, 20], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    return {
        "type": "scene", "integrator": {"type": "bssrdf", "max_depth": 3}, "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "fov": 25.0, "to_world": view, "film": film},
        "ball": {"type": "sphere", "radius": 3.0, "bsdf": surface()},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]).scale(5.0)},
    }  # fmt: skip


def test_a_scene_that_is_given_its_world_holds_its_shapes_only_and_changes_no_id(by_optix: None) -> None:
    world = mi.load_dict(scene())
    world.set_id("mine")
    inner = sharing.scene_of([s for s in world.shapes() if s.id() == "ball"], world)
    assert [s.id() for s in inner.shapes()] == ["ball"] and inner.integrator() is None
    assert sorted(s.id() for s in world.shapes()) == ["ball", "floor"] and world.id() == "mine"


@pytest.mark.parametrize("plugin", ["bssrdf", "translucent_walk"])
def test_pictures_are_the_same_by_scenes_that_are_given_their_world(
    plugin: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    described = scene() | {"integrator": {"type": plugin, "max_depth": 3}}
    alone = render(described, 16)
    monkeypatch.setattr(sharing, "_by_optix", lambda: True)
    assert np.array_equal(render(described, 16), alone)


def test_a_scene_does_not_keep_its_world(by_optix: None) -> None:
    freed = []

    class Watched(mi.SamplingIntegrator):
        def __del__(self) -> None:
            freed.append(True)

    mi.register_integrator("watched", Watched)
    world = mi.load_dict(scene() | {"integrator": {"type": "watched"}})
    inner = sharing.scene_of(world.shapes()[:1], world)
    del world
    assert freed and inner.shapes()


def test_rays_that_are_lost_beside_others_are_told(by_optix: None) -> None:
    world = mi.load_dict(scene())

    class Lost:
        """A scene whose rays meet nothing once another kernel has asked for them."""

        def __init__(self) -> None:
            self.inner, self.asked = sharing.scene_of(world.shapes()[:1], world), 0
            self.bbox, self.shapes = self.inner.bbox, self.inner.shapes

        def ray_intersect_preliminary(self, ray: object, coherent: bool) -> object:
            self.asked += 1
            return self.inner.ray_intersect_preliminary(ray, coherent, active=mi.Bool(self.asked == 1))

    sharing.check_together(world, [sharing.scene_of(world.shapes()[:1], world)])
    with pytest.raises(RuntimeError, match="must be traced by one kernel, got some lost"):
        sharing.check_together(world, [Lost()])


def test_rays_that_meet_shapes_of_others_are_told(by_optix: None) -> None:
    world, strange = mi.load_dict(scene()), sharing.scene_of([mi.load_dict({"type": "sphere"})])

    class Strange:
        """Says that it holds the floor, but holds a ball."""

        bbox, ray_intersect_preliminary = strange.bbox, strange.ray_intersect_preliminary

        def shapes(self) -> list:
            return [s for s in world.shapes() if s.id() == "floor"]

    with pytest.raises(RuntimeError, match="must be traced by one kernel, got some lost"):
        sharing.check_together(world, [Strange()])


def test_a_shape_without_an_id_is_called_what_it_may_be() -> None:
    bsdf = mi.load_dict({"type": "diffuse"})
    cube = {"type": "cube", "bsdf": bsdf}
    (merged,) = mi.load_dict({"type": "scene", "one": cube, "two": cube}).shapes()
    assert sharing.name_of(merged).startswith("without an id (Mitsuba merges meshes")
    assert sharing.name_of(mi.load_dict({"type": "scene", "one": cube}).shapes()[0]) == "'one'"
