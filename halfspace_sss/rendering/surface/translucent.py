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
    model: name of a model of the library, by default "neural"; "neural_shape", which sees the shape and needs no
        training; "full_geometry", S of this very object, which is learnt before its first render, or by
        `halfspace-sss train --scene`; "lambert", a diffuse surface of the same reflectance; or "auto", the cheapest of
        them that is within the `tolerance` of the integrator, by a measurement before the first render.
    orders: "total" (what the model lacks of the orders below two is traced; order 0 only beside a model that knows
        the object), "multiple" or "single".
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

import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.surface.boundary import boundary_of, check_eta
from halfspace_sss.rendering.surface.inside import PARAMETERS, read_inside
from halfspace_sss.rendering.surface.parameters import check_parameters
from halfspace_sss.rendering.surface.reflection import Reflection

__all__ = ["VARIABLE", "translucent_class"]

VARIABLE = ("albedo", "sigma_t", "g")  # by which light can be differentiated


def translucent_class() -> type:
    """The class of the surface for the current variant of Mitsuba."""

    class Translucent(mi.BSDF):
        """The reflection of the boundary as a BSDF, with an `inside`."""

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            check_parameters("translucent", props, (*PARAMETERS, *(key for key, _ in _boundaries(props))))
            self.inside = read_inside(props)
            self.choice = ""  # why "auto" became the model that it is
            self.boundary = boundary_of([inner for _, inner in _boundaries(props)], self.inside.medium.eta)
            self.reflection = Reflection.of(self.boundary)
            self.m_components = [self.boundary.flags(self.reflection.lobe)]
            self.m_flags = self.m_components[0]
            for name in VARIABLE:
                setattr(self, name, mi.Spectrum(np.atleast_1d(getattr(self.inside.medium, name)).tolist()))

        def traverse(self, callback: Any) -> None:
            for name in VARIABLE if self.inside.varying is None else ():
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)
            callback.put("boundary", self.boundary, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any = ()) -> None:
            # the integrators see another `inside`, and make anew what they made of it
            if self.inside.varying is None:
                self.inside = self.inside.changed(**{name: np.ravel(getattr(self, name)) for name in VARIABLE})
            check_eta(self.boundary, self.inside.medium.eta)

        def _shown(self, ctx: Any, value: Any) -> Any:
            return value if self.inside.reflection and ctx.component in (0, 0xFFFFFFFF) else 0 * value

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            bs, weight = self.reflection.sample(ctx, si, sample1, sample2, active)
            return bs, self._shown(ctx, weight)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._shown(ctx, self.reflection.eval(ctx, si, wo, active))

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._shown(ctx, self.reflection.pdf(ctx, si, wo, active))

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Translucent[{self.inside}, boundary = {self.boundary}]"

    return Translucent


def _boundaries(props: Any) -> list[tuple[str, Any]]:
    """Names and surfaces of what stands inside."""
    return [(key, found) for key, found in props.objects() if isinstance(found, mi.BSDF)]
