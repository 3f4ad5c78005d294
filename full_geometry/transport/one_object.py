"""S of one object: a half-space model times what a small network has learnt, and its directional albedo, in Dr.Jit.

The half-space model S_0 has a floor, so that no exit is out of its reach.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import SurfacePoint, Transport, opaque, plane_query
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import (
    ObjectFrame,
    PreparedExit,
    Quadratic,
    Side,
    entered,
    entering,
    first_event,
    n_local,
    n_pair,
    n_side,
    pair_features,
    side_features,
)
from full_geometry.transport.half_space import in_double
from full_geometry.transport.palette import palette_of
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.physics import fresnel
from halfspace_sss.registry import bssrdf

BASE_MODEL = "better_dipole"  # of S_0
FLOOR = 1e-2  # reflectance of the floor, over that of the half-space


class HalfSpace:
    """S_0 P_o P_i per channel, S_0 the model of the plane plus a floor that does not depend on the positions.
    Where media have textures S_0 is that of the medium of the exit, and the floor a share of its reflectance. `model`:
    name of a half-space model. `floor`: reflectance of the floor, over that of the half-space. `precise`: the model is
    asked `in_double`, for differences."""

    def __init__(self, obj: TranslucentObject, model: str, floor: float = FLOOR, precise: bool = False) -> None:
        self.object, self.name, self.floor, self.precise = obj, model, floor, precise
        self.models: list[BSSRDF] = [bssrdf(model, m) for m in obj.media]
        self.palette = None if obj.textured is None else palette_of(model, obj.geometry, obj.media, obj.textured)

    @functools.cached_property
    def floors(self) -> list[float]:
        """Per channel floor of G: floor R_d / (A N), N = 4 pi C_phi(1/eta) normalises F_t over exit directions."""
        floors = []
        for m in self.object.media:
            N = 4 * math.pi * fresnel.C_phi(1 / m.eta)
            albedo = float(m.albedo_prime)
            R_d = albedo**2 * math.exp(-2 * math.sqrt(max(1 - albedo, 0.0)))
            share = self.floor * max(R_d, 1e-6) if float(m.sigma_s) > 0 else 0.0
            floors.append(share / (self.object.geometry.area * N))
        return floors

    def end(self, at: SurfacePoint, active: mi.Bool = True) -> Side:
        return Side(at, first_event(self.object, at, active))

    def __call__(self, exit: Side, entry: Side, active: mi.Bool = True) -> mi.Spectrum:
        """1/((scene unit)² sr), 0 below the horizons."""
        query, F_t, above = self.query(exit.at, entry.at)
        if self.palette is None:
            asked = in_double(query) if self.precise else query
            values = [mi.Float(m.eval(*asked)) for m in self.models]
        else:
            values = self.palette.S([exit.at.medium], query, above & active)
        S_0 = mi.Spectrum([value + F_t * G for value, G in zip(values, self.added(exit, entry))])
        return dr.select(above, S_0 * exit.event.P * entry.event.P, 0)

    def added(self, exit: Side, entry: Side) -> list[mi.Float]:
        """Per channel what stands beside the plane, over F_t(w_o) P_o F_t(w_i) P_i."""
        floors = [opaque(floor) for floor in self.floors]
        if self.palette is None:
            return floors
        R = self.palette.reflectance(exit.at.medium.albedo)
        means = self.palette.reflectance(mi.Spectrum([opaque(m.albedo) for m in self.object.media]))
        return [floor * value / dr.maximum(mean, 1e-20) for floor, value, mean in zip(floors, R, means)]

    def query(self, o: SurfacePoint, i: SurfacePoint) -> tuple[tuple[mi.Float, ...], mi.Float, mi.Bool]:
        """The query of the models, both Fresnel transmittances, and whether both directions are above the horizons."""
        query = plane_query(i, o)
        mu_i, mu_o, eta = query[1], query[3], self.object.eta
        F_t = fresnel.F_t(mu_i, eta) * fresnel.F_t(mu_o, eta)
        return query, F_t, (mu_i > 0) & (mu_o > 0) & (dr.dot(o.w, o.n) > 0) & (dr.dot(i.w, i.n) > 0)


# ---- What leaves at an exit under the same light from everywhere, learnt beside S ------------------
# Of the light that F_t lets in, 1 - P leaves without an event; the rest leaves after one, alpha_1, or after more,
#
#     alpha = ∫ S mu_i dw_i dA_i,    alpha_1, alpha = F_t(mu_o) P_o sigmoid(a),
#
# a a small network of the exit alone: positive, and no more than is scattered. As control variates they leave an even
# sky no noise but that of what blocks it. The units before its last layer are further inputs of the network of S, of
# exit and entry: what is simple in S walks teach alpha sooner.


@dataclass(frozen=True, eq=False)
class DirectionalAlbedo:
    """The directional albedo of one object.
    `weights`: A_k (outputs, inputs) and a_k of the layers. `trusted`: (2, channels) from
    `learning.training.trusted`."""

    object: TranslucentObject
    frame: ObjectFrame
    weights: Mapping[str, np.ndarray]
    trusted: np.ndarray

    @functools.cached_property
    def _networks(self) -> tuple[Perceptron, Perceptron]:
        """All layers but the last, and that."""
        n = len(self.weights) // 2
        layers = [[self.weights[f"{name}_{k}"] for k in range(n)] for name in ("A", "a")]
        parts = ([arrays[:-1] for arrays in layers], [arrays[-1:] for arrays in layers])
        return tuple(Perceptron(*part, looped=True) for part in parts)

    def units(self, columns: list[mi.Float]) -> list[mi.Float]:
        """Inputs of the last layer for a side with these features."""
        net = self._networks[0]
        return net.numbers(net.activation(net.vector(net(columns))))

    def parts(self, at: SurfacePoint, active: mi.Bool = True) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        """What passes unscattered, alpha_1 and alpha, per channel."""
        columns = side_features(self.frame, Side(at, first_event(self.object, at, active)))
        media = self.object.media
        x, n = self._networks[1](self.units(columns)), len(media)
        live = mi.Spectrum([opaque(float(m.sigma_s) > 0) for m in media])
        enters, most = (mi.Spectrum(v) for v in entering(columns, self.object.eta, n))
        once, more = (live * most / (1 + dr.exp(-mi.Spectrum(part))) for part in (x[:n], x[n:]))
        return tuple(dr.select(active, part, 0) for part in (enters - most, once, more))

    @property
    def known(self) -> tuple[mi.Spectrum, mi.Spectrum]:
        return tuple(mi.Spectrum([opaque(float(v)) for v in row]) for row in self.trusted)

    def __call__(self, at: SurfacePoint, active: mi.Bool = True) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Orders zero and one, and alpha, per channel; 0 where they may not stand for uniform light."""
        unscattered, once, more = self.parts(at, active)
        few, others = self.known
        return few * (unscattered + once), others * more


BOUND = 6.0  # of f: where walks leave but no proposal comes, nothing else would hold it


@dataclass(frozen=True, eq=False)
class FullGeometry(Transport):
    """S = S_0 exp f, f = 6 tanh((g + h_o + h_i)/6), g a perceptron of the features of exit, entry and pair, and of
    what alpha's makes of exit and entry, h a quadratic function of those of one end.

    Orders two and more; positive; reciprocal as far as it has been learnt.

    Args:
        base: S_0.
        weights: W_k (outputs, inputs) and b_k of the layers, Q of h.
        alpha: ∫ S mu_i of an exit, learnt beside S.
        checksums: of the file of weights.
    """

    object: TranslucentObject
    frame: ObjectFrame
    base: HalfSpace
    weights: Mapping[str, np.ndarray]
    alpha: DirectionalAlbedo
    checksums: tuple[str, ...] = ()
    orders = "multiple"

    @functools.cached_property
    def _network(self) -> Perceptron:
        """The first layer in two parts, exit and the rest."""
        split = (self.weights["W_0"].shape[1] - n_pair(len(self.object.media))) // 2
        return Perceptron.named(self.weights, "W", "b", splits=[split], looped=True)

    @functools.cached_property
    def _h(self) -> Quadratic:
        return Quadratic(self.weights["Q"], n_side(len(self.object.media), n_local(self.object)))

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> PreparedExit:
        """The exit's side, for as many entries as are asked for."""
        side, net = self.base.end(at, active), self._network
        features, h = self._end(side)
        return PreparedExit(side, net.numbers(net.first(0, features, biased=True)), h)

    def S(self, exit: PreparedExit, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.
        `exit`: from `prepare`. `at`: entry, with w_i."""
        entry, net = self.base.end(entered(at, exit.side.at), active), self._network
        features, h = self._end(entry)
        features += pair_features(self.frame, exit.side, entry)
        f = mi.Spectrum(net.rest(net.activation(net.first(1, features) + net.vector(exit.hidden))))
        f += mi.Spectrum(exit.h) + mi.Spectrum(h)
        S_0 = self.base(exit.side, entry, active)
        return dr.select(active, S_0 * dr.exp(BOUND * dr.tanh(f / BOUND)), 0)

    def paint(self, at: SurfacePoint) -> mi.Spectrum:
        return self.base.palette.reflectance(at.medium.albedo)

    def _end(self, side: Side) -> tuple[list[mi.Float], list[mi.Float]]:
        """Features of one end and what uniform light makes of them; h."""
        columns = side_features(self.frame, side)
        return [*columns, *self.alpha.units(columns)], self._h(columns)
