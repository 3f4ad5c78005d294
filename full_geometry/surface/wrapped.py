"""Wrappers of a `translucent` surface: `twosided`, `normalmap`, `bumpmap`, `mask` and `blendbsdf` of Mitsuba.

- `twosided` changes nothing: an object is seen from outside.
- `normalmap` and `bumpmap` bend the shading normal m of the boundary, at exits and entries, as interpolated normals do:
  reflection, Fresnel's transmittance and refraction take m, transport keeps the geometry. No light is lost below the
  horizon of m, see `geometry.points`.
- `mask` and `blendbsdf` say what a ray outside meets: the surface with the probability of its opacity or weight, else
  nothing, or the other BSDF,

      L_o = w L_o,translucent + (1 - w) L_o,other.

  Walks inside see none of it: an object is lit as if it were whole. So a furnace stays even, and a weight that varies
  breaks reciprocity. Rays that a mask lets in meet no surface of the object from inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import EntrySample, turned
from full_geometry.geometry.shape import Geometry, name_of
from full_geometry.geometry.snapshot import held
from full_geometry.settings import per_variant
from full_geometry.surface.translucent import is_translucent

BENDS = {"NormalMap": "normalmap", "BumpMap": "bumpmap"}
WRAPPERS = ("TwoSidedBRDF", "MaskBSDF", "BlendBSDF", *BENDS)
TRANSMITS = int(mi.BSDFFlags.Transmission) | int(mi.BSDFFlags.Null)


class Mix(NamedTuple):
    """A mask or a blend.
    `weight`: texture of the share of what is `second`, else of the first. `second`: whether the translucent surface has
    that share. `other`: what has the rest."""

    weight: mi.Texture
    second: bool
    other: mi.BSDF

    def share(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        weight = dr.clip(self.weight.eval_1(si, active), 0, 1)
        return weight if self.second else 1 - weight


@dataclass(frozen=True, eq=False)
class Wrapping:
    """A translucent surface with what is around it.
    `surface`: the `translucent` BSDF. `bend`: the normal or bump map around it, or None. `mixes`: masks and blends,
    from the outermost."""

    surface: mi.BSDF
    bend: mi.BSDF | None = None
    mixes: tuple[Mix, ...] = ()

    def check(self, obj: Geometry) -> None:
        """ValueError if a mesh has no uv for its normal or bump map, or a bump map has no slopes."""
        if self.bend is not None and obj.shape.is_mesh() and not obj.shape.has_vertex_texcoords():
            raise ValueError(
                f"object {obj.name} must have uv for its {BENDS[self.bend.class_name()]}, got a mesh without"
            )
        if self.bend is not None:
            try:
                self._frame(dr.zeros(mi.SurfaceInteraction3f, 1), mi.Bool(True))
            except RuntimeError as error:  # of textures that Mitsuba cannot take slopes of
                raise ValueError(
                    f"{BENDS[self.bend.class_name()]} of object {obj.name} must be a texture with slopes, such as a "
                    f"bitmap, got {error}"
                ) from error

    def draw(self, si: mi.SurfaceInteraction3f, behind: mi.Bool, u: mi.Float, active: mi.Bool) -> mi.BSDFPtr:
        """The BSDF that a ray from outside meets at a point of the surface.
        `si`: the point. `behind`: whether the ray, let in by a mask, arrives from inside. `u`: uniform number.
        `active`: mask of lanes."""
        drawn, going = mi.BSDFPtr(self.surface), mi.Bool(active)
        for mix in self.mixes:
            share = mix.share(si, going)
            own = u < share
            drawn = dr.select(going & ~own, mi.BSDFPtr(mix.other), drawn)
            u = dr.select(own, u / dr.maximum(share, 1e-20), (u - share) / dr.maximum(1 - share, 1e-7))
            going &= own
        if any(mix.other is nothing() for mix in self.mixes):
            drawn = dr.select(active & behind, mi.BSDFPtr(nothing()), drawn)
        return drawn

    def bent(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The interaction with the shading frame that the normal or bump map makes of it."""
        if self.bend is None:
            return si
        result, w = mi.SurfaceInteraction3f(si), si.to_world(si.wi)
        result.sh_frame = dr.select(active, self._frame(si, active), si.sh_frame)
        result.wi = dr.select(active, result.to_local(w), si.wi)
        return result

    def bent_entry(self, obj: Geometry, entry: EntrySample, active: mi.Bool) -> EntrySample:
        """The entry with the bent normal, looked up where a short ray meets the object."""
        if self.bend is None:
            return entry
        si = obj.ray_intersect(obj.ray_onto(entry.p, entry.n)[0], mi.RayFlags.All, False, active)
        n = turned(self.bent(si, active & si.is_valid()).sh_frame.n, entry.n)
        return entry._replace(n_out=mi.Normal3f(dr.select(si.is_valid(), n, entry.n_out)))

    def _frame(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Frame3f:
        """Mitsuba has no function for the frame, but asks what is inside the map with it."""
        self.surface.asked = []
        try:
            self.bend.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1), active)
            frame = self.surface.asked[-1]
            if self.bend.class_name() == "BumpMap":  # which has it in the frame of the interaction
                return mi.Frame3f(*(si.to_world(axis) for axis in (frame.s, frame.t, frame.n)))
            return frame
        finally:
            self.surface.asked = None


@per_variant
def nothing() -> mi.BSDF:
    """The BSDF that lets all light pass."""
    return mi.load_dict({"type": "null"})


def wraps(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF is around a translucent surface."""
    return not is_translucent(bsdf) and _holds_one(bsdf)


def surface_of(shape: mi.Shape) -> mi.BSDF | None:
    """The `translucent` surface of a shape, whatever is around it; None where it has none.
    ValueError as of `wrapping_of`."""
    wrapping = wrapping_of(shape)
    return None if wrapping is None else wrapping.surface


def wrapping_of(shape: mi.Shape) -> Wrapping | None:
    """The `translucent` surface of a shape and what is around it; None where it has none.
    ValueError if something else than these BSDFs is around it, its other side is of another BSDF, a blend is with a
    BSDF that lets light in or stands in a normal or bump map, or there are two of these."""
    bsdf, bend, mixes = shape.bsdf(), None, []
    while not is_translucent(bsdf):
        if not _holds_one(bsdf):
            return None
        kind, parts = bsdf.class_name(), dict(held(bsdf))
        if kind not in WRAPPERS:
            raise ValueError(
                "a translucent surface must stand alone or in twosided, normalmap, bumpmap, mask or blendbsdf, got "
                f"one inside the {kind} of {name_of(shape)}"
            )
        if kind == "TwoSidedBRDF":
            if parts["brdf_0"] is not parts["brdf_1"]:
                raise ValueError(f"twosided of {name_of(shape)} must have one BSDF around a translucent one, got two")
            bsdf = parts["brdf_0"]
            continue
        if kind in BENDS:
            if bend is not None:
                raise ValueError(
                    f"a translucent surface must have one normalmap or bumpmap, got two at {name_of(shape)}"
                )
            bsdf, bend = parts["nested_bsdf"], bsdf
            continue
        if kind == "MaskBSDF":
            mixes.append(Mix(parts["opacity"], True, nothing()))
            bsdf = parts["nested_bsdf"]
            continue
        both = parts["bsdf_0"], parts["bsdf_1"]
        own = [_holds_one(each) for each in both]
        other = both[not own[1]] if not all(own) else None
        if all(own) or bend is not None or other.flags() & TRANSMITS:
            what = "two translucent ones" if all(own) else f"one inside {BENDS[bend.class_name()]}" if bend else (
                f"one with the {other.class_name()}, which lets light in"
            )  # fmt: skip
            raise ValueError(
                f"blendbsdf of {name_of(shape)} must be of a translucent and an opaque BSDF, with maps inside, "
                f"got {what}"
            )
        mixes.append(Mix(parts["weight"], own[1], other))
        bsdf = both[own[1]]
    return Wrapping(bsdf, bend, tuple(mixes))


def _holds_one(bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF is `translucent` or has such a one in it."""
    return bsdf is not None and any(is_translucent(node) for node in mi.traverse(bsdf).hierarchy)
