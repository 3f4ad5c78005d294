"""Derivatives of S by the medium of an object: by albedo, extinction and mean cosine of a channel.

    dS/dtheta = S Σ_j c_j ln S(theta + h_j),    c_j = -+1/(2h) at h_j = -+h

with transports of media to either side: the same for every model, whatever it is made of. ln S is close to linear over
the step of 1 % (of 1 - albedo near 1): the error is about 1e-4 of the derivative. At the end of the range of a model,
where one side is missing, h_j = 0, h, 2h to the other. Where S jumps, as rays of a transport meet another surface, the
mean over pairs is that of the derivative too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import SurfacePoint, Transport, TransportAround, opaque
from full_geometry.surface.translucent import VARIABLE
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf

STEP = 0.01
STENCILS = (  # offsets of both sides over h; coefficients, of what is between them too, times h
    ((-1.0, 1.0), (0.0, -0.5, 0.5)),
    ((1.0, 2.0), (-1.5, 2.0, -0.5)),
    ((-1.0, -2.0), (1.5, -2.0, 0.5)),
)


class PerturbableTransport(Transport, Protocol):
    """A transport that can be made for a perturbed medium."""

    def perturbed(self, media: Sequence[Medium]) -> Transport:
        """The transport of the same object with a perturbed medium of each channel, 1/(scene unit).
        On CUDA it takes no half precision."""


@dataclass(frozen=True, eq=False)
class Stencil:
    """Finite difference of ln S by one coefficient of the medium.
    `sides`: transports of the perturbed media. `coefficients`: of ln S of the transport itself and of both, by
    channel."""

    sides: list[Transport]
    coefficients: list[mi.Spectrum]

    def slope(self, S: mi.Spectrum, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool) -> mi.Spectrum:
        """dS/dtheta of each channel from S, arguments as of `Transport`."""
        values = [side.S(side.prepare(exit, active), at, active) for side in self.sides]
        every, least = [S, *values], S
        for value in values:
            least = dr.minimum(least, value)
        by_logarithm = sum(c * dr.log(dr.maximum(v, 1e-37)) for c, v in zip(self.coefficients, every))
        plain = sum(c * v for c, v in zip(self.coefficients, every))
        return dr.select(least > 1e-35, S * by_logarithm, plain)


class MediumDerivatives:
    """Derivatives of S of one object by the parameters of its surface.
    `surface`: its `translucent` BSDF, whose parameters are differentiated by. `mm_per_unit`: length of a scene unit,
    mm. `model`: name of the object's model. `plane`: name of the half-space model that knows the same media; "" where
    the model has no derivatives by them."""

    def __init__(self, surface: mi.BSDF, mm_per_unit: float, model: str, plane: str) -> None:
        self.surface = surface
        self.spec: Any = surface.spec
        self.mm_per_unit = mm_per_unit
        self.model = model
        self.plane = plane
        self._stencils: dict[str, Stencil] = {}

    def prepare(self, transport: Transport | None) -> None:
        """Make the transports that the derivatives need, before any loop is recorded.
        `transport`: of the object; None where no order from two on is asked for. ValueError if the model has no
        derivatives or takes no perturbed medium, or g of an object with textures is followed."""
        textured = self.spec.textured is not None  # which knows its derivatives but for g
        for name in VARIABLE if not textured else ("g",):
            with dr.resume_grad():
                wanted = dr.grad_enabled(getattr(self.surface, name))
            if wanted and textured:
                raise ValueError("g must not have gradients enabled under models of objects with textures, got them")
            if wanted and transport is not None and name not in self._stencils:
                places = [self._places(name, m) for m in self.spec.channels()]
                sides = [transport.transport.perturbed(media) for media in zip(*(media for media, _ in places))]
                columns = zip(*(coefficients for _, coefficients in places))
                self._stencils[name] = Stencil(sides, [mi.Spectrum([opaque(c) for c in column]) for column in columns])

    def check(self, names: Iterable[str]) -> None:
        """ValueError if the model has no derivative by one of the parameters."""
        for name in names:
            for m in self.spec.channels():
                self._places(name, m)

    def _places(self, name: str, m: Medium) -> tuple[list[Medium], list[float]]:
        """The media of a channel on both sides, 1/(scene unit), and the coefficients."""
        if not self.plane:
            raise ValueError(
                f"model must have derivatives by the medium, got {self.model!r}: translucent_walk, neural_shape and "
                "models of the half-space have them"
            )
        value = float(getattr(m, name))
        room = {"albedo": min(value, 1 - value) or 0.1, "sigma_t": value, "g": 1 - abs(value)}[name]
        h, refusals = STEP * room, []
        for offsets, coefficients in STENCILS:
            try:
                media = [self._medium(m, name, value + h * offset) for offset in offsets]
                for each in media:
                    bssrdf(self.plane, each)
                return media, [c / h for c in coefficients]
            except ValueError as error:
                refusals.append(str(error))
        raise ValueError(f"model {self.model!r} cannot be differentiated by {name}: {refusals[0]}")

    def _medium(self, m: Medium, name: str, value: float) -> Medium:
        ratios = {key: float(getattr(m, key)) for key in VARIABLE} | {name: value}
        return Medium.from_albedo(**ratios, eta=m.eta).scaled(self.mm_per_unit)

    def S(self, S: mi.Spectrum, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool) -> mi.Spectrum:
        """S with its derivatives where they are followed; arguments as of `Transport`, and S itself."""
        result = S
        for name in VARIABLE:
            theta = getattr(self.surface, name)
            if not dr.grad_enabled(theta):
                continue
            with dr.suspend_grad():
                slope = self._stencils[name].slope(S, exit, at, active)
            result = result + slope * (theta - dr.detach(theta))
        return result

    def coefficients(self, media: Sequence[Medium]) -> list[tuple[mi.Float, mi.Float, mi.Float]]:
        """sigma_s, sigma_t in 1/(scene unit) and g of each channel, with derivatives where they are followed."""
        results = []
        for k, m in enumerate(media):
            albedo, sigma_t, g = (getattr(self.surface, name)[k] for name in VARIABLE)
            sigma_t = sigma_t * opaque(self.mm_per_unit)
            exact = tuple(opaque(v) for v in (m.sigma_s, m.sigma_t, m.g))
            results.append(tuple(dr.replace_grad(a, b) for a, b in zip(exact, (albedo * sigma_t, sigma_t, g))))
        return results


@dataclass(frozen=True, eq=False)
class DifferentiableTransport(TransportAround):
    """A `PerturbableTransport` whose S has derivatives by the medium.
    `derivatives`: of its object."""

    derivatives: MediumDerivatives

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> tuple[Any, SurfacePoint]:
        """The prepared exit of the transport, and the exit itself for transports of perturbed media."""
        return self.transport.prepare(at, active), at

    def S(self, exit: tuple[Any, SurfacePoint], at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        prepared, out = exit
        with dr.suspend_grad():
            S = self.transport.S(prepared, at, active)
        return self.derivatives.S(S, out, at, active)
