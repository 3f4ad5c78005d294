"""Scenes of single objects beside the scene that they stand in, whose rays are traced in one kernel.

OptiX knows one table of shaders in a kernel. Dr.Jit does no more than log that a ray needs another one, and the ray
then meets nothing. Mitsuba adds the shapes of a scene to the table of another that it is given at its making.
"""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["check_together", "name_of", "number_of", "rays_into", "scene_of"]

TRIALS = 256  # rays


def name_of(shape: Any) -> str:
    """The id of a shape in quotes; what it may be, where it has none."""
    return repr(shape.id()) if shape.id() else "without an id (Mitsuba merges meshes that have the same surface)"


def _by_optix() -> bool:
    import mitsuba as mi

    return mi.variant().startswith("cuda")


def number_of(scene: Any) -> int:
    """What tells the scenes apart that objects may stand in; only OptiX has to know."""
    return scene.ptr if _by_optix() else 0


def scene_of(shapes: list[Any], world: Any = None) -> Any:
    """A Mitsuba scene that holds these shapes, which keep their ids.

    Args:
        shapes: of Mitsuba.
        world: the scene that they stand in, if rays are traced in both by one kernel. It is not kept alive, and must
            not be one that this function made.
    """
    import mitsuba as mi

    named = [*shapes, world] if world is not None and _by_optix() else shapes
    names = [known.id() for known in named]
    scene = mi.load_dict({"type": "scene", **{f"shape{k}": known for k, known in enumerate(named)}})
    for known, name in zip(named, names):
        known.set_id(name)
    return scene


def rays_into(box: Any, n: int) -> Any:
    """Rays from about a bounding box to places in it."""
    import mitsuba as mi

    low, high = np.array(box.min, dtype=float), np.array(box.max, dtype=float)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    rng = np.random.default_rng(7)
    ends = rng.standard_normal((2, 3, n))
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    start = centre[:, None] + 1.1 * radius * ends[0]
    target = centre[:, None] + 0.9 * radius * ends[1] * rng.random(n) ** (1 / 3)
    along = target - start
    along /= np.linalg.norm(along, axis=0)
    return mi.Ray3f(mi.Point3f(start), mi.Vector3f(along))


def check_together(world: Any, scenes: list[Any]) -> None:
    """Try rays in a scene and in those of objects in it by one kernel, where that may fail.

    Args:
        world: the scene around all.
        scenes: from `scene_of`.

    Raises:
        RuntimeError: rays meet other things than by kernels of their own, or shapes that are not in their scene.
    """
    if not _by_optix():
        return
    import drjit as dr
    import mitsuba as mi

    tried = [scene for scene in (world, *scenes) if scene.bbox().valid()]
    rays = [rays_into(scene.bbox(), TRIALS) for scene in tried]
    dr.eval(rays)
    alone = [np.array(_met(scene, ray)) for scene, ray in zip(tried, rays)]
    together = [_met(scene, ray) for scene, ray in zip(tried, rays)]
    dr.eval(together)
    for scene, by_itself, beside in zip(tried, alone, map(np.array, together)):
        own = [0, *(int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes())]
        if (by_itself != beside).any() or (scene is not world and not np.isin(beside, own).all()):
            raise RuntimeError(
                "rays of objects and of the scene around them must be traced by one kernel, got some lost"
            )


def _met(scene: Any, ray: Any) -> Any:
    """The numbers of the shapes that rays meet in Dr.Jit's registry, 0 for none."""
    import drjit as dr
    import mitsuba as mi

    hit = scene.ray_intersect_preliminary(ray, False)
    return dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0)
