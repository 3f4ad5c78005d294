"""What is below a translucent surface, from the parameters of the plugin: medium, model and scattering orders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from halfspace_sss import materials
from halfspace_sss.checks import check_choice
from halfspace_sss.materials.channels import one_channel
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.transports import model_names
from halfspace_sss.rendering.surface.variants import variant_channels

__all__ = ["ORDERS", "PARAMETERS", "Inside", "read_inside"]

ORDERS = ("total", "multiple", "single")
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


def read_inside(props: Any) -> Inside:
    """The inside from the parameters of a surface.

    Raises:
        ValueError: a parameter is missing, unknown in value, or out of range.
    """
    label, medium, varying = _medium(props)
    model, orders = props.get("model", "neural"), props.get("orders", "total")
    check_choice("orders", orders, ORDERS)
    check_choice("model", model, model_names())
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
    import mitsuba as mi

    try:
        parts = value.split(",") if isinstance(value, str) else np.ravel(np.array(value, dtype=float)).tolist()
        found = np.array([float(part) for part in parts])
    except (TypeError, ValueError):
        got = f"a {value.class_name().partition('Impl')[0]}" if isinstance(value, mi.Object) else repr(value)
        raise ValueError(f"{key} must be a number, rgb, or numbers separated by commas, got {got}") from None
    return float(found[0]) if len(found) == 1 else found
