"""Learning S = alpha p from the exits of walks: -T log p + (alpha - T)², and -T_c log pi_c for the channels."""

from __future__ import annotations

import numpy as np
import torch

from full_geometry.alpha_p.model import AlphaP
from full_geometry.features import n_side
from full_geometry.flow.chart import Chart
from full_geometry.flow.conditional import ConditionalFlow
from full_geometry.flow.context import N_CONTEXT
from full_geometry.flow.fitting import FlowNetwork
from full_geometry.flow.sampler import FlowSampler
from full_geometry.flow.training import FlowRecipe, Schedule
from full_geometry.flow.walks import Walks, flow_walks
from full_geometry.identity import frame_of
from full_geometry.learning.learner import Layers, PatchLogits
from full_geometry.patches import Patches, PatchSampler, cluster
from full_geometry.subject import Subject

__all__ = ["fit_alpha_p"]

HIDDEN = (32, 32)


def fit_alpha_p(subject: Subject, recipe: FlowRecipe | None = None, seed: int = 0) -> AlphaP:
    """S = alpha p of an object.

    Args:
        subject: the object, a mesh.
        recipe: CPU seconds, sizes and rates.
        seed: of everything.

    Raises:
        ValueError: the shape is no mesh.
    """
    recipe, frame = recipe or FlowRecipe(), frame_of(subject)
    patches = Patches(subject, frame, cluster(subject, frame, seed=seed))
    chart, n, channels = Chart(subject, frame, patches), n_side(len(subject.media)), len(subject.media)
    generator = torch.Generator().manual_seed(seed)
    nets = torch.nn.ModuleDict({
        "patches": PatchLogits(n, patches.areas, recipe.patch_hidden, seed),
        "flow": FlowNetwork(4, N_CONTEXT, recipe.hidden, seed),
        "alpha": Layers([n, *HIDDEN, 1], generator),
        "shares": Layers([2 * n + N_CONTEXT, *HIDDEN, channels], generator),
    })  # fmt: skip
    pilot = flow_walks(subject, frame, patches, chart, recipe.chunk, (seed, 70))
    mean = pilot.total.mean(axis=0).astype(np.float64)
    scale = np.where(mean > 0, 1 / np.maximum(mean, 1e-30), 0.0).astype(np.float32)
    schedule = Schedule(list(nets.parameters()), recipe)
    order = np.random.default_rng([seed, 71])

    def loss(walks: Walks, rows: np.ndarray) -> torch.Tensor:
        begun = order.integers(0, walks.drawn, len(rows))
        return _density_loss(nets, walks, rows, scale) * (len(walks.T) / walks.drawn) + _alpha_loss(
            nets, walks, begun, scale
        )

    def data(k: int) -> Walks:
        return flow_walks(subject, frame, patches, chart, recipe.chunk, (seed, 72, k))

    schedule.run(data, loss, seed)
    sampler = FlowSampler(
        PatchSampler(frame, patches, nets["patches"].arrays()), chart, ConditionalFlow(4, nets["flow"].arrays())
    )
    weights = {**nets["alpha"].arrays("A", "a"), **nets["shares"].arrays("P", "p")}
    return AlphaP(subject, sampler, weights, tuple(float(v) for v in mean))


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
