"""First exits of paths from the camera: while walks gather light for an image, where they leave is kept for learning.

A path that meets an object first goes in at x_o against the direction w_o of the eye, or is reflected there, and leaves
at x_i into w_i with the throughput T, so that over all such paths, those included that do not enter,

    ∫∫ S(x_i, w_i; x_o, w_o) mu_i f(x_i, w_i) dw_i dA_i = E[T f(x_i, w_i)].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.surface.horizon import lifted
from halfspace_sss.rendering.walk.light import Light, LightVisitor
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.rendering.walk.steps import Crossing, Event, Walk

__all__ = ["FirstExitVisitor", "FirstExits", "Watched"]


@dataclass
class FirstExits:
    """One lane for each path; normals point outwards, directions away from the surface, which see shading normals."""

    object: mi.Int32  # the number of the object that the path meets first, or -1
    x_o: mi.Point3f
    n_o: mi.Normal3f  # geometric
    n_o_shading: mi.Normal3f
    w_o: mi.Vector3f
    throughput: mi.Spectrum  # T; 0 where no walk left
    x_i: mi.Point3f
    n_i: mi.Normal3f  # geometric
    n_i_shading: mi.Normal3f
    w_i: mi.Vector3f
    order: mi.UInt32  # scattering events
    face: mi.UInt32  # at x_i

    @classmethod
    def of(cls, scene: Any, media: WalkMedia, rays: Any) -> FirstExits:
        """What rays of the camera meet first, and room for where their walks leave."""
        si = scene.ray_intersect(rays, mi.RayFlags.All, coherent=True)
        k = media.index_of(si.shape, si.is_valid())
        si = media.seen(si, k, rays.d)
        n = dr.width(rays)
        kinds = mi.Spectrum, mi.Point3f, mi.Normal3f, mi.Normal3f, mi.Vector3f, mi.UInt32, mi.UInt32
        found = cls(k, mi.Point3f(si.p), mi.Normal3f(si.n), mi.Normal3f(si.sh_frame.n), mi.Vector3f(-rays.d),
                    *(dr.zeros(kind, n) for kind in kinds))  # fmt: skip
        dr.eval(found)
        return found

    def of_object(self, k: int) -> FirstExits:
        """The lanes of paths that meet object k first."""
        kept = dr.compress(self.object == k)
        lanes = {name: dr.gather(type(value), value, kept) for name, value in vars(self).items()}
        found = FirstExits(**lanes)
        dr.eval(found)
        return found

    def gather(self, lanes: Any) -> FirstExits:
        """The paths of the given lanes."""
        return FirstExits(**{name: dr.gather(type(value), value, lanes) for name, value in vars(self).items()})


@dataclass
class Watched:
    """Light of a path, its number, and whether it has met no surface from outside but the one it went in by."""

    light: Light
    index: mi.UInt32
    first: mi.Bool


@dataclass(frozen=True, eq=False)
class FirstExitVisitor:
    """Gathers light, and stores the first exit of each path at its number.

    Args:
        light: what gathers.
        exits: where they are stored.
    """

    light: LightVisitor
    exits: FirstExits

    def event(self, walk: Walk, record: Watched, event: Event) -> tuple[Walk, Watched]:
        walk, light = self.light.event(walk, record.light, event)
        return walk, replace(record, light=light)

    def boundary(self, walk: Walk, record: Watched, si: Any, active: Any) -> tuple[Walk, Watched]:
        walk, light = self.light.boundary(walk, record.light, si, active)
        return walk, replace(record, light=light)

    def surface(self, walk: Walk, record: Watched, si: Any, bsdf: Any, k: Any) -> tuple[Walk, Watched]:
        walk, light = self.light.surface(walk, record.light, si, bsdf, k)
        return walk, replace(record, light=light)

    def crossing(self, walk: Walk, record: Watched, crossing: Crossing) -> tuple[Walk, Watched]:
        walk, light = self.light.crossing(walk, record.light, crossing)
        to, si = self.exits, crossing.si
        leaves, n_shading = walk.alive & crossing.leaves & record.first, lifted(si.sh_frame.n, si.n, walk.d)
        pairs = ((to.throughput, walk.weight), (to.x_i, si.p), (to.n_i, si.n), (to.n_i_shading, n_shading),
                 (to.w_i, walk.d), (to.order, walk.order), (to.face, si.prim_index))  # fmt: skip
        for target, value in pairs:
            dr.scatter(target, type(target)(value), record.index, leaves)
        return walk, replace(record, light=light)
