"""Light that samplers of entries are fitted to and compared under: a sky, a direction, a small light near the object.

Each gives for an entry a direction of incidence and the light from there over its density. The object itself casts
shadows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.subject import Subject
from halfspace_sss.rendering.surface.horizon import cosine_above
from halfspace_sss.rendering.transport.plane import number, place

__all__ = ["LIGHTINGS", "Lighting", "lighting"]

LIGHTINGS = ("sky", "direction", "near light")
TOWARDS = np.array([0.48, 0.8, 0.36])  # the direction, and where the near light stands
GAP = 0.08  # of the near light from the surface, over the size of the object


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light of one kind.

    Args:
        name: one of `LIGHTINGS`.
        subject: the object, which casts shadows.
        aim: (entry, pair of uniforms) -> direction towards the light, its value over the density, and its distance.
    """

    name: str
    subject: Subject
    aim: Callable[[Any, Any], tuple[Any, Any, Any]]

    def sample(self, entry: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """w_i at an entry, and the light from there over its density: 0 in the shadow."""
        import drjit as dr
        import mitsuba as mi

        w, value, distance = self.aim(entry, u)
        ray = place(entry.p, mi.Normal3f(entry.n * number(self.subject.found.sign))).spawn_ray(w)
        ray.maxt = distance
        lit = active & (dr.dot(w, entry.n_face) > 0)
        return w, dr.select(lit & ~self.subject.found.scene.ray_test(ray, False, lit), value, 0)


def lighting(name: str, subject: Subject) -> Lighting:
    """A kind of light about an object: radiance 1 from everywhere, irradiance 1 from a direction, or intensity 1.

    Raises:
        ValueError: there is no such kind.
    """
    import drjit as dr
    import mitsuba as mi

    if name not in LIGHTINGS:
        raise ValueError(f"lighting must be one of {', '.join(LIGHTINGS)}, got {name!r}")
    towards = mi.Vector3f(*TOWARDS.tolist())
    place_of_light = mi.Point3f(*map(number, _above(subject)))

    def sky(entry: Any, u: Any) -> tuple:
        w, density = cosine_above(entry.n_out, entry.n_face, u)
        return w, 1 / dr.maximum(density, 1e-6), mi.Float(dr.inf)

    def direction(entry: Any, u: Any) -> tuple:
        return mi.Vector3f(towards), mi.Float(1), mi.Float(dr.inf)

    def near(entry: Any, u: Any) -> tuple:
        d = place_of_light - entry.p
        r = dr.norm(d)
        return mi.Vector3f(d / r), 1 / (r * r), r

    return Lighting(name, subject, {"sky": sky, "direction": direction, "near light": near}[name])


def _above(subject: Subject) -> np.ndarray:
    """A point near the part of the surface that lies farthest towards the light."""
    import mitsuba as mi

    from halfspace_sss.tracing.walk import generator, pass_seed

    p = np.array(subject.random_points(generator(mi, 4096, pass_seed(23))).p)
    return p[:, np.argmax(TOWARDS @ p)] + GAP * float(subject.found.size) * TOWARDS
