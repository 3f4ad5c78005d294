"""The Mitsuba surface `translucent`: which material, model and scattering orders an object has.

In a scene:

    {"type": "translucent", "material": "marble", "model": "directional_dipole"}

    <bsdf type="translucent">
        <string name="material" value="marble"/>
        <bsdf type="roughdielectric">
            <float name="alpha" value="0.1"/> <float name="int_ior" value="1.5"/> <float name="ext_ior" value="1"/>
        </bsdf>
    </bsdf>
    <bsdf type="translucent">
        <volume name="sigma_t" type="gridvolume"> <string name="filename" value="wax.vol"/> </volume>
        <string name="albedo" value="0.99, 0.97, 0.9"/>
    </bsdf>

Parameters, all optional but the medium:
    material: a name of the registry; or else `sigma_s`, `sigma_a` (1/mm; numbers, rgb, or strings of numbers separated
        by commas), `g` and `eta`; or `sigma_t` (1/mm), `albedo` and `scale` (a factor of sigma_t) instead of the
        first two. For a medium that varies in space `albedo` and one of `sigma_t` and `scale` may be a `gridvolume`.
    model: name of a model of the library, by default "neural".
    orders: "total" (single scattering is added where the model lacks it), "multiple" or "single".
    channel: R, G or B, or a number; under a mono variant, for a medium with channels.
    dilution: of a material that has one, see `halfspace_sss.materials.load`.
    a BSDF inside: the boundary, a `dielectric` or `roughdielectric` with int_ior / ext_ior equal to the eta of the
        medium; by default smooth.
    reflection: whether the boundary reflects light, by default true.

`mitsuba.traverse` shows `albedo`, `sigma_t` (1/mm) and `g` of each channel, and the parameters of the boundary.
To an integrator that knows nothing of the inside, the surface shows its reflection only.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from halfspace_sss.rendering.surface.inside import PARAMETERS, read_inside
from halfspace_sss.rendering.surface.parameters import check_parameters

__all__ = ["VARIABLE", "translucent_class"]

VARIABLE = ("albedo", "sigma_t", "g")  # by which light can be differentiated


def translucent_class() -> type:
    """The class of the surface for the current variant of Mitsuba."""
    import mitsuba as mi

    class Translucent(mi.BSDF):
        """The reflection of the boundary as a BSDF, with an `inside`."""

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            check_parameters("translucent", props, (*PARAMETERS, *(key for key, _ in _boundaries(props))))
            self.inside = read_inside(props)
            self.boundary = _boundary(props, self.inside.medium.eta)
            self.lobe = _reflection_lobe(self.boundary)
            self.m_components = [self.boundary.flags(self.lobe)]
            self.m_flags = self.m_components[0]
            self._expose()

        def _expose(self) -> None:
            """The parameters of the medium as arrays that can be changed and differentiated by."""
            medium = self.inside.medium
            for name in VARIABLE:
                setattr(self, name, mi.Spectrum(np.atleast_1d(getattr(medium, name)).astype(float).tolist()))

        def traverse(self, callback: Any) -> None:
            for name in VARIABLE:
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)
            callback.put("boundary", self.boundary, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any = ()) -> None:
            values = {name: np.array(getattr(self, name), dtype=float).ravel() for name in VARIABLE}
            inside = self.inside.changed(**values)
            check_eta(self.boundary, inside.medium.eta)
            if inside != self.inside:
                self.inside = inside  # what is made of it is made anew when the scene is rendered next

        def _context(self, ctx: Any) -> Any:
            return mi.BSDFContext(ctx.mode, ctx.type_mask, self.lobe)

        def _shown(self, ctx: Any) -> bool:
            return self.inside.reflection and ctx.component in (0, 0xFFFFFFFF)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            seen, sign = _from_outside(si)
            bs, weight = self.boundary.sample(self._context(ctx), seen, sample1, sample2, active)
            bs.wo = _turned(bs.wo, sign)
            bs.sampled_component = 0
            return bs, weight if self._shown(ctx) else 0 * weight

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            seen, sign = _from_outside(si)
            value = self.boundary.eval(self._context(ctx), seen, _turned(wo, sign), active)
            return value if self._shown(ctx) else 0 * value

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            seen, sign = _from_outside(si)
            value = self.boundary.pdf(self._context(ctx), seen, _turned(wo, sign), active)
            return value if self._shown(ctx) else 0 * value

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Translucent[{self.inside}, boundary = {self.boundary}]"

    return Translucent


def _from_outside(si: Any) -> tuple[Any, Any]:
    """The interaction with the normal on the side that is seen, which is the outside, and 1 or -1 if it was turned."""
    import drjit as dr
    import mitsuba as mi

    sign = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, mi.Float(-1), 1)
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = _turned(si.wi, sign)
    return seen, sign


def _turned(w: Any, sign: Any) -> Any:
    """A local direction in the frame that is turned about its first axis where the sign is -1."""
    import mitsuba as mi

    return mi.Vector3f(w.x, w.y * sign, w.z * sign)


def _boundaries(props: Any) -> list[tuple[str, Any]]:
    """Names and surfaces of what stands inside."""
    import mitsuba as mi

    return [(key, found) for key, found in props.objects() if isinstance(found, mi.BSDF)]


def _boundary(props: Any, eta: float) -> Any:
    """The dielectric of the surface."""
    import mitsuba as mi

    inner = [boundary for _, boundary in _boundaries(props)]
    if len(inner) > 1:
        raise ValueError(f"a translucent surface must have at most one BSDF inside, got {len(inner)}")
    if not inner:
        return mi.load_dict({"type": "dielectric", "int_ior": float(eta), "ext_ior": 1.0})
    check_eta(inner[0], eta)
    return inner[0]


def check_eta(boundary: Any, eta: float) -> None:
    """Refuse a boundary of another index than the medium's."""
    import mitsuba as mi

    found = mi.traverse(boundary).get("eta")
    found = None if found is None else float(np.max(np.array(found)))
    if found is None or abs(found - eta) > 2e-3 * eta:
        raise ValueError(
            f"the boundary must be a dielectric with eta {eta:g} of the medium (int_ior/ext_ior), got {found}"
        )


def _reflection_lobe(boundary: Any) -> int:
    import mitsuba as mi

    for k in range(boundary.component_count()):
        if boundary.flags(k) & int(mi.BSDFFlags.Reflection):
            return k
    raise ValueError(f"the boundary must reflect, got {boundary}")
