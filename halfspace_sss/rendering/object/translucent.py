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
        `halfspace-sss train object`; "lambert", a diffuse surface of the same reflectance; or "auto", the cheapest of
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

import functools
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from halfspace_sss import materials
from halfspace_sss.checks import check_choice
from halfspace_sss.materials.registry import one_channel
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.boundary import Reflection, boundary_of, check_eta
from halfspace_sss.rendering.object.registry import model_names
from halfspace_sss.rendering.object.settings import ORDERS, check_parameters, variant_channels
from halfspace_sss.rendering.object.varying import constant_value, mean_of_grids, varying_medium

__all__ = ["Inside", "PARAMETERS", "VARIABLE", "is_translucent", "read_inside", "translucent_class"]

VARIABLE = ("albedo", "sigma_t", "g")  # by which light can be differentiated


def translucent_class() -> type:
    """The class of the surface for the current variant of Mitsuba."""
    return _class(mi.variant())


def is_translucent(bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF is a `translucent` surface, and so has an `inside`."""
    return isinstance(bsdf, translucent_class())


@functools.cache
def _class(variant: str) -> type:
    """The class of a variant, which must be the current one."""

    class Translucent(mi.BSDF):
        """The reflection of the boundary as a BSDF, with an `inside`."""

        def __init__(self, props: mi.Properties) -> None:
            mi.BSDF.__init__(self, props)
            check_parameters("translucent", props, (*PARAMETERS, *(key for key, _ in _boundaries(props))))
            self.inside = read_inside(props)
            self.boundary = boundary_of([inner for _, inner in _boundaries(props)], self.inside.medium.eta)
            self.reflection = Reflection.of(self.boundary)
            self.m_components = [self.boundary.flags(self.reflection.lobe)]
            self.m_flags = self.m_components[0]
            for name in VARIABLE:
                setattr(self, name, mi.Spectrum(np.atleast_1d(getattr(self.inside.medium, name)).tolist()))

        def traverse(self, callback: mi.TraversalCallback) -> None:
            for name in VARIABLE if self.inside.varying is None else ():
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)
            callback.put("boundary", self.boundary, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any = ()) -> None:
            # the integrators see another `inside`, and make anew what they made of it
            if self.inside.varying is None:
                self.inside = self.inside.changed(**{name: np.ravel(getattr(self, name)) for name in VARIABLE})
            check_eta(self.boundary, self.inside.medium.eta)

        def _shown(self, ctx: mi.BSDFContext, value: Any) -> Any:
            return value if self.inside.reflection and ctx.component in (0, 0xFFFFFFFF) else 0 * value

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[Any, Any]:
            bs, weight = self.reflection.sample(ctx, si, sample1, sample2, active)
            return bs, self._shown(ctx, weight)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> Any:
            return self._shown(ctx, self.reflection.eval(ctx, si, wo, active))

        def pdf(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True) -> Any:
            return self._shown(ctx, self.reflection.pdf(ctx, si, wo, active))

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[Any, Any]:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Translucent[{self.inside}, boundary = {self.boundary}]"

    return Translucent


def _boundaries(props: mi.Properties) -> list[tuple[str, Any]]:
    """Names and surfaces of what stands inside."""
    return [(key, found) for key, found in props.objects() if isinstance(found, mi.BSDF)]


# --------------------------------------------------------------------------------------------------
# What is below a translucent surface, from the parameters of the plugin: medium, model and scattering orders.


PARAMETERS = (
    "material", "sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "g", "eta", "model", "orders", "channel",
    "dilution", "reflection",
)  # fmt: skip


@dataclass(frozen=True)
class Inside:
    """What is below a translucent surface.

    Args:
        label: name of the material, or of its coefficients.
        medium: with 3 channels under RGB variants, 1/mm; scalar under mono ones.
        model: name of the model.
        orders: "total", "multiple" or "single".
        reflection: whether the boundary reflects.
        varying: how the medium varies in space, a `VaryingMedium`, or None. `medium` then has the means of the grids.
    """

    label: str
    medium: Medium
    model: str
    orders: str
    reflection: bool
    varying: Any = None

    def channels(self) -> list[Medium]:
        """The scalar media of the channels."""
        n = self.medium.n_channels
        return [self.medium] if n is None else [self.medium.channel(k) for k in range(n)]

    def changed(self, **values: np.ndarray) -> Inside:
        """The same with another medium; numbers that are the same in single precision are kept as they are.

        Args:
            values: `albedo`, `sigma_t` (1/mm) and `g`, one for each channel.
        """
        m, n = self.medium, self.medium.n_channels
        values = {name: np.asarray(value, dtype=float) for name, value in values.items()}
        old = {name: np.atleast_1d(getattr(m, name)) for name in values}
        kept = {name: np.float32(old[name]) == np.float32(value) for name, value in values.items()}
        if all(same.all() for same in kept.values()):
            return self
        new = {name: np.where(kept[name], old[name], value) for name, value in values.items()}
        if n is None:
            new = {name: float(value[0]) for name, value in new.items()}
        return replace(self, label="medium", medium=Medium.from_albedo(**new, eta=m.eta))


def read_inside(props: mi.Properties) -> Inside:
    """The inside from the parameters of a surface.

    Raises:
        ValueError: a parameter is missing, unknown in value, or out of range.
    """
    label, medium, varying = _medium(props)
    model, orders = props.get("model", "neural"), props.get("orders", "total")
    check_choice("orders", orders, ORDERS)
    check_choice("model", model, model_names())
    return Inside(label, medium, model, orders, bool(props.get("reflection", True)), varying)


def _medium(props: mi.Properties) -> tuple[str, Medium, Any]:

    keys = ("sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "g", "eta")
    inline = {key: constant_value(props[key]) for key in keys if key in props}
    if "material" in props:
        if inline:
            raise ValueError(f"material must stand without {', '.join(inline)}, got both")
        dilution = float(props["dilution"]) if "dilution" in props else None
        material = materials.load(props["material"], dilution=dilution)
        label, medium, names = material.name, material.medium, material.channels
    elif "dilution" in props:
        raise ValueError(f"dilution must be left out without material, got {props['dilution']!r}")
    elif {"sigma_s", "sigma_a"} <= inline.keys() or {"sigma_t", "albedo"} <= inline.keys():
        label, names = "medium", None
        medium, varying = _inline_medium(inline)
        if varying is not None:
            return label, medium, varying
    else:
        raise ValueError("a translucent surface must have material, or sigma_s and sigma_a, or sigma_t and albedo")
    return *_for_variant(label, medium, names, props), None


def _inline_medium(inline: dict) -> tuple[Medium, Any]:
    """The medium of coefficients, and how it varies if it does."""

    values = {key: value if isinstance(value, mi.Volume) else _numbers(key, value) for key, value in inline.items()}
    volumes = [key for key, value in values.items() if isinstance(value, mi.Volume)]
    for key in volumes:
        if key not in ("sigma_t", "scale", "albedo"):
            raise ValueError(f"{key} must be constant, got a volume; sigma_t, scale and albedo may vary")
    eta = float(np.max(values.pop("eta", 1.3)))
    if "sigma_s" in values:
        if extra := values.keys() - {"sigma_s", "sigma_a", "g"}:
            raise ValueError(f"sigma_s and sigma_a must stand without {', '.join(sorted(extra))}, got both")
        return Medium(**values, eta=eta), None
    g, scale = values.get("g", 0.0), values.get("scale", 1.0)
    if not volumes:
        return Medium.from_albedo(values["albedo"], np.asarray(values["sigma_t"]) * scale, g, eta), None
    varying = varying_medium(values["sigma_t"], values["albedo"], scale, variant_channels())
    return mean_of_grids(varying, g, eta), varying


def _for_variant(label: str, medium: Medium, names: Any, props: mi.Properties) -> tuple[str, Medium]:
    n, wanted = medium.n_channels, variant_channels()
    channel = props["channel"] if "channel" in props else None
    if wanted == 1 and n is not None:
        if channel is None:
            raise ValueError(f"channel must be given under a mono variant, got none for {label} with {n} channels")
        by_name = {name.casefold(): k for k, name in enumerate(names or ())}
        return f"{label} {channel}", one_channel(medium, by_name.get(str(channel).casefold(), channel))[1]
    if channel is not None:
        raise ValueError(f"channel must be left out under this variant or for this medium, got {channel!r}")
    if wanted == 3 and n is None:
        same = {key: np.full(3, float(getattr(medium, key))) for key in ("sigma_s", "sigma_a", "g")}
        return label, Medium(**same, eta=medium.eta)
    if wanted == 3 and n != 3:
        raise ValueError(f"medium must have 1 or 3 channels, got {n}")
    return label, medium


def _numbers(key: str, value: Any) -> Any:
    """A number, or one per channel, from a parameter."""

    try:
        parts = value.split(",") if isinstance(value, str) else np.ravel(np.array(value, dtype=float)).tolist()
        found = np.array([float(part) for part in parts])
    except (TypeError, ValueError):
        got = f"a {value.class_name().partition('Impl')[0]}" if isinstance(value, mi.Object) else repr(value)
        raise ValueError(f"{key} must be a number, rgb, or numbers separated by commas, got {got}") from None
    return float(found[0]) if len(found) == 1 else found
