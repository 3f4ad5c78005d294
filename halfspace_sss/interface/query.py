"""The query of a half-space model."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from halfspace_sss.arrays import Library, Real
from halfspace_sss.physics.fresnel import mu_internal, sine


@dataclass(frozen=True)
class Query:
    """A half-space query in mean free paths, with refracted cosines, in one array library.
    The refracted directions of travel, in a frame whose x axis points from x_i to x_o and z outwards, are w_12 =
    (-sin_i cos phi_i, -sin_i sin phi_i, -mu_i_in) and w_21 = (sin_o cos phi_o, sin_o sin phi_o, mu_o_in)."""

    lib: Library
    r: Real
    mu_i: Real
    phi_i: Real
    mu_o: Real
    phi_o: Real
    eta: float
    r_mm: Real | None = None
    sigma_t: Real | None = None  # r = sigma_t r_mm, kept so that `in_float64` does not inherit the rounding of r

    @functools.cached_property
    def index(self) -> Real:
        """eta as a constant; matched media, which are answered without Fresnel's equations, keep the number 1."""
        return self.constant(self.eta) if isinstance(self.eta, (int, float)) and self.eta != 1 else self.eta

    @functools.cached_property
    def mu_i_in(self) -> Real:
        return mu_internal(self.mu_i, self.index)

    @functools.cached_property
    def mu_o_in(self) -> Real:
        return mu_internal(self.mu_o, self.index)

    @functools.cached_property
    def sin_i(self) -> Real:
        """Sine of the refracted angle, sqrt(1 - mu_i²)/eta, at most 1."""
        return self._sine(self.mu_i)

    @functools.cached_property
    def sin_o(self) -> Real:
        return self._sine(self.mu_o)

    def _sine(self, mu: Real) -> Real:
        return self.lib.minimum(sine(mu) / self.index, 1.0)

    def constant(self, value: Real) -> Real:
        """A constant of the model (number, or one per channel) in the library and precision of the query."""
        return self.lib.constant(value, self.r)

    def in_float64(self) -> Query:
        """The same query in float64, for formulas whose terms cancel."""
        f = self.lib.float64
        r = f(self.r) if self.r_mm is None else f(self.r_mm)
        if self.r_mm is not None:
            r = self.lib.constant(self.sigma_t, r) * r
        return Query(self.lib, r, f(self.mu_i), f(self.phi_i), f(self.mu_o), f(self.phi_o), self.eta)
