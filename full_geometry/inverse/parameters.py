"""Parameters that are fitted, as variables without bounds: logit albedo, log sigma_t, mfp or alpha, artanh g."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.shape import name_of
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.objects.objects import KnowsUnit, translucent_shapes
from full_geometry.surface.medium_derivatives import MediumDerivatives
from full_geometry.surface.translucent import VARIABLE, is_rough
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.models import lookup
from halfspace_sss.checks import check_choice
from halfspace_sss.neural.universal import Neural
from halfspace_sss.registry import bssrdf

NAMES = ("albedo", "sigma_t", "mfp", "g", "alpha")
ROUGHNESS = "boundary.alpha.value"  # key of alpha in the surface
ALBEDO = (1e-4, 1 - 1e-5)  # bounds
G = 0.98  # |g| is less
ALPHA = (0.01, 1.0)  # bounds
SIZES = (0.02, 5e3)  # of the object, mean free paths
NEAR = 0.02  # of the way between bounds, in the variable, that counts as at a bound


def translucent_object(scene: mi.Scene, name: str | None) -> mi.Shape:
    """The translucent object of a scene by name, or the only one.

    Raises:
        ValueError: there is none of that name, or there are several and no name was given.
    """
    shapes = {shape.id(): shape for shape in translucent_shapes(scene)}
    if name is None and len(shapes) == 1:
        return next(iter(shapes.values()))
    if name is None:
        raise ValueError(f"object must be one of {', '.join(shapes)}, got none")
    check_choice("object", name, shapes)
    return shapes[name]


def check_derivatives(integrator: mi.Integrator, shape: mi.Shape, names: Sequence[str]) -> None:
    """Refuse images without derivatives by parameters of an object, before anything is rendered or learnt.

    Raises:
        ValueError: the integrator is neither `translucent_walk` nor `bssrdf`, or of the latter the light is not
            sampled, or the model of the object has no derivative by a parameter.
    """
    if not isinstance(integrator, KnowsUnit):
        raise ValueError(f"integrator must be translucent_walk or bssrdf, got {integrator.class_name()}")
    if not is_bssrdf(integrator):
        return
    settings, spec = integrator.settings, surface_of(shape).spec
    if settings.light != "sampled":
        raise ValueError(f"light must be sampled to fit a medium, got {settings.light}")
    model = settings.model or spec.model
    capabilities = lookup(model).capabilities
    if spec.textured is not None:
        made = bssrdf(model, spec.channels()[0]) if capabilities.of_half_space else None
        if made is None or (made.checksums and not isinstance(made, Neural)):
            raise ValueError(
                f"model must have derivatives by textures, got {model!r}: analytic models and neural have them"
            )
        if "g" in names:
            raise ValueError(f"g must not be fitted beside textures by {model!r}: translucent_walk has its derivative")
        return
    coefficients = ["sigma_t" if name == "mfp" else name for name in names]
    derivatives = MediumDerivatives(surface_of(shape), integrator.mm_per_unit, model, capabilities.derivatives)
    derivatives.check(n for n in coefficients if n in VARIABLE)


def check_names(names: Sequence[str], known: Sequence[str]) -> None:
    """ValueError if names are none of those known, of a shape, there twice, or ask for sigma_t and mfp both."""
    if not names or len(set(names)) < len(names):
        raise ValueError(f"parameters must be one or more of {', '.join(known)}, each once, got {list(names)}")
    for name in names:
        if name.rsplit(".", 1)[-1] in (*mesh.GEOMETRY, "to_world"):
            raise ValueError(f"parameter must not be of a shape, whose silhouettes have no derivatives, got {name!r}")
        check_choice("parameter", name, known)
    if {"sigma_t", "mfp"} <= set(names):
        raise ValueError("parameters must be sigma_t or mfp, got both")


def roughness(shape: mi.Shape) -> float:
    """alpha of the boundary of an object.

    Raises:
        ValueError: it is smooth, or its alpha is a texture or one for each axis.
    """
    parameters = mi.traverse(surface_of(shape))
    if ROUGHNESS not in parameters:
        got = "a texture or one for each axis" if is_rough(surface_of(shape).boundary) else "a smooth boundary"
        raise ValueError(f"alpha of {name_of(shape)} must be a number of a roughdielectric to be fitted, got {got}")
    return float(np.ravel(parameters[ROUGHNESS])[0])


def size_bounds(shape: mi.Shape, mm_per_unit: float) -> tuple[float, float]:
    """Bounds of sigma_t (1/mm): those at which the object is `SIZES` mean free paths large."""
    box = shape.bbox()
    extent = float(dr.norm(box.max - box.min)) * mm_per_unit
    return SIZES[0] / extent, SIZES[1] / extent


class FitParameters:
    """The parameters of one object that are fitted, by name.

    Raises:
        ValueError: a name is unknown or there twice, sigma_t and mfp are both asked for, or the medium varies.
    """

    def __init__(self, names: Sequence[str], shape: mi.Shape, mm_per_unit: float) -> None:
        check_names(names, NAMES)
        if not surface_of(shape).spec.is_homogeneous:
            raise ValueError(f"the medium of {name_of(shape)} must be homogeneous to be fitted, got one that varies")
        self.names, self.shape = tuple(names), shape
        self.sizes = size_bounds(shape, mm_per_unit)  # bounds of sigma_t, 1/mm

    def start(self) -> dict[str, mi.Float | mi.Spectrum]:
        """The variables of the medium as it is, within the bounds."""
        surface, result = surface_of(self.shape), {}
        for name in self.names:
            if name == "g":  # one for all channels
                x = mi.Float(np.arctanh(np.clip(np.mean(np.ravel(surface.g)), -0.95 * G, 0.95 * G) / G))
            elif name == "alpha":
                x = mi.Float(np.log(roughness(self.shape)))
            elif name == "albedo":
                a = np.clip(np.ravel(surface.albedo), 0.01, 0.999)
                x = mi.Spectrum(np.log(a / (1 - a)).tolist())
            else:
                x = mi.Spectrum((np.log(np.ravel(surface.sigma_t)) * (1 if name == "sigma_t" else -1)).tolist())
            result[name] = self.clipped(name, x)
        return result

    def bounds(self, name: str) -> tuple[float, float]:
        if name == "albedo":
            return tuple(float(np.log(a / (1 - a))) for a in ALBEDO)
        if name == "g":
            return -3.0, 3.0
        if name == "alpha":
            return tuple(float(np.log(alpha)) for alpha in ALPHA)
        low, high = (float(np.log(size)) for size in self.sizes)
        return (low, high) if name == "sigma_t" else (-high, -low)

    def clipped(self, name: str, x: mi.Float | mi.Spectrum) -> mi.Float | mi.Spectrum:
        """A variable within its bounds, as data of kernels: literals would be code, compiled anew in each step."""
        clipped = type(x)(dr.clip(x, *self.bounds(name)))
        dr.make_opaque(clipped)
        return clipped

    def values(self, x: dict[str, mi.Float | mi.Spectrum]) -> dict[str, mi.Spectrum]:
        """Coefficients of the surface and alpha, with the gradients of the variables."""
        result = {}
        for name, value in x.items():
            if name == "albedo":
                result[name] = 1 / (1 + dr.exp(-value))
            elif name == "g":
                result[name] = mi.Spectrum(G * dr.tanh(value))
            elif name == "alpha":
                result[name] = dr.exp(value)
            else:
                result["sigma_t"] = dr.exp(value if name == "sigma_t" else -value)
        return result

    def put(self, x: dict[str, mi.Float | mi.Spectrum]) -> None:
        surface, values = surface_of(self.shape), self.values(x)
        if "alpha" in values:
            parameters = mi.traverse(surface)
            parameters[ROUGHNESS] = values.pop("alpha")
            parameters.update()
        for name, value in values.items():
            setattr(surface, name, value)
        surface.parameters_changed([name for name in VARIABLE if name in values])

    def shown(self, x: dict[str, mi.Float | mi.Spectrum]) -> dict[str, np.ndarray]:
        """The parameters as numbers; mfp in mm, sigma_t in 1/mm."""
        values = {name: np.ravel(np.array(dr.detach(value), dtype=float)) for name, value in self.values(x).items()}
        if "mfp" in self.names:
            values["mfp"] = 1 / values.pop("sigma_t")
        if "g" in values:
            values["g"] = values["g"][:1]
        return {name: values[name] for name in self.names}

    def slopes(self, x: dict[str, mi.Float | mi.Spectrum]) -> dict[str, np.ndarray]:
        """Derivatives of the shown parameters by their variables."""
        shown, result = self.shown(x), {}
        for name, value in shown.items():
            by = {"albedo": value * (1 - value), "g": G - value**2 / G}
            result[name] = by.get(name, value)
        return result

    def at_bounds(self, x: dict[str, mi.Float | mi.Spectrum]) -> list[str]:
        """A sentence for each parameter that lies at a bound."""
        said = []
        for name, value in self.shown(x).items():
            low, high = self.bounds(name)
            place = (np.ravel(np.array(x[name], dtype=float)) - low) / (high - low)
            for c, share in enumerate(place):
                if not NEAR < share < 1 - NEAR:
                    which = f" of channel {c}" if len(place) > 1 else ""
                    said.append(f"{name}{which} is at its bound: {value[c]:.4g}")
        return said
