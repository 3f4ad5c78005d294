"""How the light of an object varies with its medium: derivatives by albedo, extinction and mean cosine of a channel.

    dS/dtheta = S Σ_j c_j ln S(theta + h_j),    c_j = -+1/(2h) at h_j = -+h

with models of media to either side: the same for every model, whatever it is made of. ln S is close to linear over the
step of 1 % (of 1 - albedo near 1): the error is about 1e-4 of the derivative. At the end of the range of a model, where
one side is missing, h_j = 0, h, 2h to the other.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from halfspace_sss.interface.model import bssrdf
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.surface.translucent import VARIABLE
from halfspace_sss.rendering.transport.plane import number

__all__ = ["Variation"]

STEP = 0.01
Stencil = list[tuple[Any, float]]  # model, or None for the model itself, and its coefficient


class Variation:
    """Of one object.

    Args:
        surface: its `translucent` BSDF, whose parameters are differentiated by.
        mm_per_unit: length of a scene unit, mm.
    """

    def __init__(self, surface: Any, mm_per_unit: float) -> None:
        self.surface, self.inside, self.mm_per_unit = surface, surface.inside, mm_per_unit
        self._stencils: dict[str, list[Stencil]] = {}

    def prepare(self) -> None:
        """Make the models that the derivatives need, before any loop is recorded.

        Raises:
            ValueError: the model knows no medium beside its own.
        """
        for name in VARIABLE:
            with dr.resume_grad():
                wanted = dr.grad_enabled(getattr(self.surface, name))
            if wanted and name not in self._stencils:
                self._stencils[name] = [self._stencil(name, m) for m in self.inside.channels()]

    def _stencil(self, name: str, m: Medium) -> Stencil:
        value = float(getattr(m, name))
        room = {"albedo": min(value, 1 - value) or 0.1, "sigma_t": value, "g": 1 - abs(value)}[name]
        h, refusals = STEP * room, []
        for offsets, coefficients in (
            ((-h, h), (-0.5 / h, 0.5 / h)),
            ((0.0, h, 2 * h), (-1.5 / h, 2 / h, -0.5 / h)),
            ((0.0, -h, -2 * h), (1.5 / h, -2 / h, 0.5 / h)),
        ):
            try:
                models = [self._model(m, name, value + offset) if offset else None for offset in offsets]
                return list(zip(models, coefficients))
            except ValueError as error:
                refusals.append(str(error))
        raise ValueError(f"model {self.inside.model!r} cannot be differentiated by {name}: {refusals[0]}")

    def _model(self, m: Medium, name: str, value: float) -> Any:
        ratios = {key: float(getattr(m, key)) for key in VARIABLE} | {name: value}
        return bssrdf(self.inside.model, Medium.from_albedo(**ratios, eta=m.eta).scaled(self.mm_per_unit))

    def S(self, values: list[Any], query: tuple) -> list[Any]:
        """The S of each channel at a query in scene units, with their derivatives where they are followed."""
        for name in VARIABLE:
            theta = getattr(self.surface, name)
            if not dr.grad_enabled(theta):
                continue
            with detached():
                slopes = [_slope(s, dr.detach(v), query) for s, v in zip(self._stencils[name], values)]
            values = [v + slope * (t - dr.detach(t)) for v, slope, t in zip(values, slopes, theta)]
        return values

    def coefficients(self, media: list[Medium]) -> list[tuple[Any, Any, Any]]:
        """sigma_s, sigma_t in 1/(scene unit) and g of each channel, with derivatives where they are followed."""
        found = []
        for k, m in enumerate(media):
            albedo, sigma_t, g = (getattr(self.surface, name)[k] for name in VARIABLE)
            sigma_t = sigma_t * number(self.mm_per_unit)
            exact = tuple(number(v) for v in (m.sigma_s, m.sigma_t, m.g))
            found.append(tuple(dr.replace_grad(a, b) for a, b in zip(exact, (albedo * sigma_t, sigma_t, g))))
        return found


def _slope(stencil: Stencil, S: Any, query: tuple) -> Any:
    precise = _precise(query)
    sides = [(S if model is None else type(S)(model.eval(*precise)), number(c)) for model, c in stencil]
    least = sides[0][0]
    for value, _ in sides[1:]:
        least = dr.minimum(least, value)
    by_logarithm = S * sum(c * dr.log(dr.maximum(value, 1e-37)) for value, c in sides)
    return dr.select((least > 1e-35) & (S > 0), by_logarithm, sum(c * value for value, c in sides))


def _precise(query: tuple) -> tuple:
    """In double precision on CUDA: to single, networks answer there in half, which a difference would enlarge."""
    kind = dr.expr_t(*query)
    if dr.backend_v(kind) != dr.JitBackend.CUDA:
        return query
    return tuple(dr.float64_array_t(kind)(v) for v in query)
