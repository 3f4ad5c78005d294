"""Where the camera sees an object: rays to its visible points, and how much of the image they fill.

Points in which the boundary mirrors a lamp, or through which one would be seen if the inside were clear, are left out:
by chance the few of them that are drawn would decide all means.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene, bounds_of
from full_geometry.geometry.rounding import ray_from
from full_geometry.precomputed.transport_matrix import R_2
from full_geometry.surface.wrapped import surface_of

LAUNCH, LAUNCHES = 2**16, 16  # rays of a look at the scene, and the most looks for an object that is hardly seen
FEWEST = 32  # exits of an object that is assessed
CHAIN = 4  # boundaries that light of a lamp may meet without scattering, mirrored by all or passing through


@dataclass(frozen=True, eq=False)
class Exits:
    """Rays of the camera that meet an object first.

    Args:
        o, d: origins and directions, float32 (3, n).
        share: of the image that the object fills.
        pixels: of the film that it fills.
    """

    o: np.ndarray
    d: np.ndarray
    share: float
    pixels: float

    @property
    def n(self) -> int:
        return self.o.shape[1]

    def first(self, n: int) -> Exits:
        """The first n of them, which are as random as all."""
        return replace(self, o=self.o[:, :n], d=self.d[:, :n])

    def rays(self, each: int) -> mi.Ray3f:
        """Every ray `each` times, next to each other."""
        index = dr.arange(mi.UInt32, self.n * each) // dr.opaque(mi.UInt32, each)
        o, d = (mi.TensorXf(v) for v in (self.o, self.d))
        columns = [dr.gather(mi.Float, table.array, index + k * self.n) for table in (o, d) for k in range(3)]
        ray = mi.Ray3f(mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:]))
        dr.eval(ray)
        return ray


def visible_exits(scene: mi.Scene, shapes: list[mi.Shape], sensor: int, n: int, seed: int) -> list[Exits | None]:
    """Find n rays of a sensor that meet each shape first; fewer where it is hardly seen, None where it is not.

    Args:
        scene: the Mitsuba scene.
        shapes: of it.
        sensor: number of the sensor.
        n: rays of each.
        seed: of the rays.
    """
    camera = scene.sensors()[sensor]
    pixels = int(np.prod(np.array(camera.film().crop_size())))
    results: list[list[np.ndarray]] = [[] for _ in shapes]
    drawn = 0
    for k in range(LAUNCHES):
        rays, hit = _look(scene, camera, shapes, (seed, k))
        drawn += LAUNCH
        for mine, mask in zip(results, hit):
            mine.append(rays[:, mask])
        if all(sum(part.shape[1] for part in mine) >= n for mine in results):
            break
    made: list[Exits | None] = []
    for mine in results:
        rays = np.concatenate(mine, axis=1)
        share = rays.shape[1] / drawn
        few = rays.shape[1] < FEWEST
        made.append(None if few else Exits(rays[:3, :n], rays[3:, :n], share, share * pixels))
    return made


def _look(
    scene: mi.Scene, camera: mi.Sensor, shapes: list[mi.Shape], seed: tuple[int, int]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Random rays of a camera, (6, LAUNCH), evenly over its film, and which of them meet each shape first."""
    rng = np.random.default_rng([*seed, 23])
    rows = rng.random((5, LAUNCH))
    rows[1:3] = (rows[1:3, :1] + np.arange(LAUNCH) * np.array(R_2)[:, None]) % 1
    u = [mi.Float(row) for row in np.minimum(rows, 1 - 2**-24).astype(np.float32)]
    ray, _ = camera.sample_ray_differential(camera.shutter_open(), u[0], mi.Point2f(*u[1:3]), mi.Point2f(*u[3:]))
    si = scene.ray_intersect(mi.Ray3f(ray), mi.RayFlags.All, coherent=False)
    plain = si.is_valid() & ~(_shows_lamp(scene, shapes, si, False) | _shows_lamp(scene, shapes, si, True))
    hit = [np.array((si.shape == mi.ShapePtr(shape)) & plain) for shape in shapes]
    columns = np.concatenate([np.array(v, dtype=np.float32).reshape(3, -1) for v in (ray.o, ray.d)])
    return np.broadcast_to(columns, (6, LAUNCH)) if columns.shape[1] == 1 else columns, hit


def _shows_lamp(scene: mi.Scene, shapes: list[mi.Shape], si: mi.SurfaceInteraction3f, through: bool) -> mi.Bool:
    """Whether smooth boundaries show an emitter other than the environment, as mirrors or `through` clear objects."""
    active, result, instance_scene = si.is_valid(), mi.Bool(False), InstanceScene([], {}, bounds_of(scene.shapes()))
    for _ in range(CHAIN):
        eta, translucent = mi.Float(1), mi.Bool(False)
        for shape in shapes:
            here = si.shape == mi.ShapePtr(shape)
            eta, translucent = (
                dr.select(here, float(surface_of(shape).spec.channels()[0].eta), eta),
                translucent | here,
            )
        active &= translucent
        cosine = mi.Frame3f.cos_theta(si.wi)
        reflectance, cosine_t, _, eta_ti = mi.fresnel(cosine, eta)
        passes = ((cosine < 0) | through) & (reflectance < 1)
        onwards = dr.select(passes, mi.refract(si.wi, cosine_t, eta_ti), mi.reflect(si.wi))
        onward = ray_from(si, si.to_world(onwards), instance_scene.rounding(si))
        si = scene.ray_intersect(onward, mi.RayFlags.All, False, active)
        active &= si.is_valid()
        result |= active & (si.emitter(scene) != None)  # noqa: E711
    return result
