"""S mu_i = alpha(x_o, w_o) p(x_i, w_i | x_o, w_o) of one object, after "8DNA" (2026), in Dr.Jit.

p is exact and on the surface: learnt weights of patches, in the patch a flow over its coordinates and those of w_i.
Channels share p and differ by their shares of the light, so with C channels

    S_c mu_i = alpha p C pi_c(x_i, w_i, x_o, w_o),    sum_c pi_c = 1,    alpha = E[mean_c T_c].

Throughputs are over their means (`scale`), so that all channels count alike. Orders two and more; not reciprocal.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from full_geometry.features import Side, side_features
from full_geometry.first_event import first_event
from full_geometry.flow.context import context, direction_square
from full_geometry.flow.sampler import FlowSampler
from full_geometry.patches import PatchWeights
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.rendering.transport.plane import number

__all__ = ["AlphaP", "PreparedAlphaP"]

CLEAR = 1e-4  # of the size of the object: where the ray that finds a face begins


class PreparedAlphaP(NamedTuple):
    """Of an exit: its side and features, alpha, and the weights of patches."""

    side: Side
    features: list[Any]
    alpha: Any
    weights: PatchWeights


@dataclass(frozen=True, eq=False)
class AlphaP:
    """The model.

    Args:
        subject: the object.
        sampler: p, a flow of four dimensions.
        weights: layers A_k, a_k of log alpha and P_k, p_k of the shares of the channels.
        scale: mean throughput of each channel.
    """

    subject: Subject
    sampler: FlowSampler
    weights: Mapping[str, np.ndarray]
    scale: tuple[float, ...]
    orders = "multiple"

    def _face(self, at: SurfacePoint, active: Any) -> tuple[Any, Any]:
        """The face that a point lies on, as a short ray from outside meets it, and where there is one."""
        import drjit as dr
        import mitsuba as mi

        clear = number(CLEAR * self.subject.found.size)
        ray = mi.Ray3f(mi.Point3f(at.p + at.n * clear), mi.Vector3f(-at.n))
        ray.maxt = 2 * clear
        hit = self.subject.found.scene.ray_intersect_preliminary(ray, False, active=mi.Bool(active))
        return dr.select(hit.is_valid(), mi.UInt32(hit.prim_index), 0), active & hit.is_valid()

    @functools.cached_property
    def _log_alpha(self) -> Perceptron:
        return Perceptron.named(self.weights, "A", "a", looped=True)

    @functools.cached_property
    def _shares(self) -> Perceptron:
        return Perceptron.named(self.weights, "P", "p", looped=True)

    def prepare(self, at: SurfacePoint, active: Any = True) -> PreparedAlphaP:
        """alpha and the weights of patches of an exit."""
        import drjit as dr

        side = Side(at, first_event(self.subject, at, active))
        features = side_features(self.sampler.frame, side)
        alpha = dr.exp(self._log_alpha(features)[0])
        return PreparedAlphaP(side, features, alpha, self.sampler.patches.prepare(side))

    def S(self, exit: PreparedAlphaP, at: SurfacePoint, active: Any = True, face: Any = None) -> Any:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.

        Args:
            exit: from `prepare`.
            at: entry, with w_i.
            active: mask of lanes.
                face: of the entry; found by a ray if it is not given.
        """
        import drjit as dr
        import mitsuba as mi

        if face is None:
            face, active = self._face(at, active)
        sampler = self.sampler
        patch = sampler.patches.patches.row("patch", face)
        told = context(sampler.frame, exit.side, sampler.chart.frame(patch))
        u = sampler.chart.coordinates(face, at.p)
        towards = direction_square(at.n_out, exit.side.at.p - at.p, at.w)
        p = sampler.patches.density(exit.weights, face) * sampler.flow.density(told, [*u, *towards]) / dr.pi
        entry = side_features(sampler.frame, Side(at, first_event(self.subject, at, active)))
        logits = self._shares([*exit.features, *entry, *told])
        most = functools.reduce(dr.maximum, logits)
        shares = [dr.exp(v - most) for v in logits]
        total = sum(shares)
        S = mi.Spectrum([exit.alpha * p * len(shares) * v / total * c for v, c in zip(shares, self.scale)])
        above = (dr.dot(at.w, at.n_out) > 0) & (dr.dot(at.w, at.n) > 0) & (dr.dot(exit.side.at.w, exit.side.at.n) > 0)
        return dr.select(active & above, S, 0)
