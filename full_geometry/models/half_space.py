"""S_0: what a half-space model says of an object, with a floor so that no exit is out of its reach."""

from __future__ import annotations

import functools
import math
from typing import Any

import drjit as dr
import mitsuba as mi

from full_geometry.object.features import Side
from full_geometry.object.first_event import first_event
from full_geometry.object.subject import Subject
from halfspace_sss.interface.model import BSSRDF, bssrdf
from halfspace_sss.physics import fresnel
from halfspace_sss.rendering.object.points import SurfacePoint, number, plane_query

FLOOR = 1e-2  # reflectance of the floor, over that of the half-space


class HalfSpace:
    """S_0 P_o P_i per channel, S_0 the model of the plane plus a floor that does not depend on the positions.

    Args:
        subject: the object.
        model: name of a half-space model.
        floor: reflectance of the floor, over that of the half-space.
    """

    def __init__(self, subject: Subject, model: str, floor: float = FLOOR) -> None:
        self.subject, self.name, self.floor = subject, model, floor
        self.models: list[BSSRDF] = [bssrdf(model, m) for m in subject.media]

    @functools.cached_property
    def floors(self) -> list[float]:
        """Per channel floor of G: floor R_d / (A N), N = 4 pi C_phi(1/eta) normalises F_t over exit directions."""
        floors = []
        for m in self.subject.media:
            N = 4 * math.pi * fresnel.C_phi(1 / m.eta)
            albedo = float(m.albedo_prime)
            R_d = albedo**2 * math.exp(-2 * math.sqrt(max(1 - albedo, 0.0)))
            share = self.floor * max(R_d, 1e-6) if float(m.sigma_s) > 0 else 0.0
            floors.append(share / (self.subject.object.area * N))
        return floors

    def end(self, at: SurfacePoint, active: Any = True) -> Side:
        """What belongs to one end alone."""
        return Side(at, first_event(self.subject, at, active))

    def __call__(self, exit: Side, entry: Side, active: Any = True) -> Any:
        """1/((scene unit)² sr), 0 below the horizons."""
        query, F_t, above = self.query(exit.at, entry.at)
        S_0 = mi.Spectrum([m.eval(*query) + F_t * G for m, G in zip(self.models, self.added(exit, entry))])
        return dr.select(above, S_0 * exit.event.P * entry.event.P, 0)

    def added(self, exit: Side, entry: Side) -> list[Any]:
        """Per channel what stands beside the plane, over F_t(w_o) P_o F_t(w_i) P_i."""
        return [number(floor) for floor in self.floors]

    def query(self, o: SurfacePoint, i: SurfacePoint) -> tuple[tuple, Any, Any]:
        """The query of the models, both Fresnel transmittances, and whether both directions are above the horizons."""
        query = plane_query(i, o, "distance")
        mu_i, mu_o, eta = query[1], query[3], number(self.subject.eta)
        F_t = fresnel.F_t(mu_i, eta) * fresnel.F_t(mu_o, eta)
        return query, F_t, (mu_i > 0) & (mu_o > 0) & (dr.dot(o.w, o.n) > 0) & (dr.dot(i.w, i.n) > 0)
