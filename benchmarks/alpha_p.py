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
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from benchmarks.fits import Objective
from benchmarks.flow import N_CONTEXT, Chart, ConditionalFlow, FlowSampler, context, direction_square
from benchmarks.flow_training import FlowBatch, FlowNetwork, FlowRecipe, Walks, flow_walks, walk_batches
from full_geometry.geometry.points import SurfacePoint, opaque
from full_geometry.learning.network_fitting import DenseLayers, PatchLogits
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import Side, first_event, n_side, side_features
from full_geometry.transport.patches import Patches, PatchSampler, PatchWeights, cluster
from full_geometry.transport.storing import frame_of
from halfspace_sss.arrays import Lanes
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.neural.training.fit import fit

CLEAR = 1e-4  # of the size of the object: where the ray that finds a face begins


class PreparedAlphaP(NamedTuple):
    """Of an exit: its side and features, alpha, and the weights of patches."""

    side: Side
    features: list[Lanes]
    alpha: Lanes
    weights: PatchWeights


@dataclass(frozen=True, eq=False)
class AlphaP:
    """The model.

    Args:
        obj: the object.
        sampler: p, a flow of four dimensions.
        weights: layers A_k, a_k of log alpha and P_k, p_k of the shares of the channels.
        scale: mean throughput of each channel.
    """

    object: TranslucentObject
    sampler: FlowSampler
    weights: Mapping[str, np.ndarray]
    scale: tuple[float, ...]
    orders = "multiple"

    def _face(self, at: SurfacePoint, active: Lanes) -> tuple[Lanes, Lanes]:
        """The face that a point lies on, as a short ray from outside meets it, and where there is one."""
        clear = opaque(CLEAR * self.object.geometry.size)
        ray = mi.Ray3f(mi.Point3f(at.p + at.n * clear), mi.Vector3f(-at.n))
        ray.maxt = 2 * clear
        hit = self.object.geometry.scene.ray_intersect_preliminary(ray, False, active=mi.Bool(active))
        return dr.select(hit.is_valid(), mi.UInt32(hit.prim_index), 0), active & hit.is_valid()

    @functools.cached_property
    def _log_alpha(self) -> Perceptron:
        return Perceptron.named(self.weights, "A", "a", looped=True)

    @functools.cached_property
    def _shares(self) -> Perceptron:
        return Perceptron.named(self.weights, "P", "p", looped=True)

    def prepare(self, at: SurfacePoint, active: Lanes = True) -> PreparedAlphaP:
        """alpha and the weights of patches of an exit."""
        side = Side(at, first_event(self.object, at, active))
        features = side_features(self.sampler.frame, side)
        alpha = dr.exp(self._log_alpha(features)[0])
        return PreparedAlphaP(side, features, alpha, self.sampler.patches.prepare(side))

    def S(self, exit: PreparedAlphaP, at: SurfacePoint, active: Lanes = True, face: Lanes = None) -> Lanes:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.

        Args:
            exit: from `prepare`.
            at: entry, with w_i.
            active: mask of lanes.
                face: of the entry; found by a ray if it is not given.
        """
        if face is None:
            face, active = self._face(at, active)
        sampler = self.sampler
        patch = sampler.patches.patches.row("patch", face)
        told = context(sampler.frame, exit.side, sampler.chart.frame(patch))
        u = sampler.chart.coordinates(face, at.p)
        towards = direction_square(at.n_out, exit.side.at.p - at.p, at.w)
        p = sampler.patches.density(exit.weights, face) * sampler.flow.density(told, [*u, *towards]) / dr.pi
        entry = side_features(sampler.frame, Side(at, first_event(self.object, at, active)))
        logits = self._shares([*exit.features, *entry, *told])
        most = functools.reduce(dr.maximum, logits)
        shares = [dr.exp(v - most) for v in logits]
        total = sum(shares)
        S = mi.Spectrum([exit.alpha * p * len(shares) * v / total * c for v, c in zip(shares, self.scale)])
        above = (dr.dot(at.w, at.n_out) > 0) & (dr.dot(at.w, at.n) > 0) & (dr.dot(exit.side.at.w, exit.side.at.n) > 0)
        return dr.select(active & above, S, 0)


# ----------------------------------------------------------------------------------------------------
# Learning S = alpha p from the exits of walks: -T log p + (alpha - T)², and -T_c log pi_c for the channels.

HIDDEN = (32, 32)


def fit_alpha_p(obj: TranslucentObject, recipe: FlowRecipe | None = None, seed: int = 0) -> AlphaP:
    """S = alpha p of an object.

    Args:
        obj: the object, a mesh.
        recipe: CPU seconds, sizes and rates.
        seed: of everything.

    Raises:
        ValueError: the shape is no mesh.
    """
    recipe, frame = recipe or FlowRecipe(), frame_of(obj)
    patches = Patches(obj, frame, cluster(obj, frame, seed=seed))
    chart, n, channels = Chart(obj, frame, patches), n_side(len(obj.media)), len(obj.media)
    generator = torch.Generator().manual_seed(seed)
    nets = torch.nn.ModuleDict({
        "patches": PatchLogits(n, patches.areas, recipe.patch_hidden, seed),
        "flow": FlowNetwork(4, N_CONTEXT, recipe.hidden, seed),
        "alpha": DenseLayers([n, *HIDDEN, 1], generator),
        "shares": DenseLayers([2 * n + N_CONTEXT, *HIDDEN, channels], generator),
    })  # fmt: skip
    pilot = flow_walks(obj, frame, patches, chart, recipe.chunk, (seed, 70))
    mean = pilot.total.mean(axis=0).astype(np.float64)
    scale = np.where(mean > 0, 1 / np.maximum(mean, 1e-30), 0.0).astype(np.float32)
    order = np.random.default_rng([seed, 71])

    def loss(batch: FlowBatch) -> torch.Tensor:
        walks, rows = batch
        begun = order.integers(0, walks.drawn, len(rows))
        return _density_loss(nets, walks, rows, scale) * (len(walks.T) / walks.drawn) + _alpha_loss(
            nets, walks, begun, scale
        )

    def data(k: int) -> Walks:
        return flow_walks(obj, frame, patches, chart, recipe.chunk, (seed, 72, k))

    fit(Objective(nets, loss), walk_batches(data, recipe, seed), recipe.schedule, seed)
    sampler = FlowSampler(
        PatchSampler(frame, patches, nets["patches"].arrays()), chart, ConditionalFlow(4, nets["flow"].arrays())
    )
    weights = {**nets["alpha"].arrays("A", "a"), **nets["shares"].arrays("P", "p")}
    return AlphaP(obj, sampler, weights, tuple(float(v) for v in mean))


def _density_loss(nets: torch.nn.ModuleDict, walks: Walks, rows: np.ndarray, scale: np.ndarray) -> torch.Tensor:
    """-T log p, T the mean over channels, and -T_c log pi_c."""
    T = torch.from_numpy(walks.T[rows] * scale)
    exit, told = torch.from_numpy(walks.exit[rows]), torch.from_numpy(walks.told[rows])
    logits = torch.log_softmax(nets["patches"](exit.T), dim=0)
    log_p = logits.gather(0, torch.from_numpy(walks.patch[rows])[None])[0]
    log_p = log_p + nets["flow"].log_density(told, torch.from_numpy(walks.u[rows]))
    both = torch.cat((exit, torch.from_numpy(walks.entry[rows]), told), dim=1)
    log_shares = torch.log_softmax(nets["shares"](both.T), dim=0).T
    return -(T.mean(dim=1) * log_p).mean() - (T * log_shares).sum(dim=1).mean() / T.shape[1]


def _alpha_loss(nets: torch.nn.ModuleDict, walks: Walks, begun: np.ndarray, scale: np.ndarray) -> torch.Tensor:
    """(alpha - T)² over walks that were begun, also those that did not leave."""
    T = torch.from_numpy(walks.total[begun] * scale).mean(dim=1)
    alpha = torch.exp(nets["alpha"](torch.from_numpy(walks.starts[begun]).T)[0])
    return ((alpha - T) ** 2).mean()
