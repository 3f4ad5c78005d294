"""The Mitsuba surface `translucent`: which material, model and scattering orders an object has.

In a scene:

    {"type": "translucent", "material": "marble", "model": "directional_dipole"}

    <bsdf type="translucent">
        <string name="material" value="marble"/>
        <bsdf type="roughdielectric">
            <float name="alpha" value="0.1"/> <float name="int_ior" value="1.5"/> <float name="ext_ior" value="1"/>
        </bsdf>
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

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from halfspace_sss import materials
from halfspace_sss.checks import check_choice
from halfspace_sss.interface.model import models
from halfspace_sss.materials.channels import one_channel
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.parameters import check_parameters
from halfspace_sss.rendering.surface.variants import variant_channels

__all__ = ["ORDERS", "VARIABLE", "Inside", "translucent_class"]

ORDERS = ("total", "multiple", "single")
VARIABLE = ("albedo", "sigma_t", "g")  # by which light can be differentiated
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
        old = {name: np.atleast_1d(getattr(m, name)) for name in values}
        kept = {name: np.float32(old[name]) == np.float32(value) for name, value in values.items()}
        if all(same.all() for same in kept.values()):
            return self
        new = {name: np.where(kept[name], old[name], value) for name, value in values.items()}
        if n is None:
            new = {name: float(value[0]) for name, value in new.items()}
        return replace(self, label="medium", medium=Medium.from_albedo(**new, eta=m.eta))


def translucent_class() -> type:
    """The class of the surface for the current variant of Mitsuba."""
    import mitsuba as mi

    class Translucent(mi.BSDF):
        """The reflection of the boundary as a BSDF, with an `inside`."""

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
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


def read_inside(props: Any) -> Inside:
    """The inside from the parameters of a surface.

    Raises:
        ValueError: a parameter is missing, unknown in value, or out of range.
    """
    check_parameters("translucent", props, (*PARAMETERS, *(key for key, _ in _boundaries(props))))
    label, medium, varying = _medium(props)
    model, orders = props.get("model", "neural"), props.get("orders", "total")
    check_choice("orders", orders, ORDERS)
    check_choice("model", model, models())
    return Inside(label, medium, model, orders, bool(props.get("reflection", True)), varying)


def _medium(props: Any) -> tuple[str, Medium, Any]:
    from halfspace_sss.rendering.surface.varying import constant_value

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
    import mitsuba as mi

    from halfspace_sss.rendering.surface.varying import mean_of_grids, varying_medium

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


def _for_variant(label: str, medium: Medium, names: Any, props: Any) -> tuple[str, Medium]:
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
        raise ValueError(f"{key} must be a number, rgb, or numbers separated by commas, got {value!r}") from None
    return float(found[0]) if len(found) == 1 else found


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
