"""What is trained: networks of one medium, also the paper's.

Their batches are random queries from a pool of noisy maps in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from halfspace_sss.arrays import Library, library
from halfspace_sss.maps.noisy_maps import CellGrid, Groups, backbone_mass, radial_edges
from halfspace_sss.neural.network import (
    LOG_RANGE,
    N_FEATURES,
    RELU,
    Network,
    layer_shapes,
    medium_features,
    symmetric_features,
)
from halfspace_sss.neural.paper_model import N_INPUTS, paper_inputs
from halfspace_sss.physics.backbone import backbone, length_scale, unwarp
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium

ENERGY_SHARE = 0.5  # of the queries of a batch follow the energy over u, the others are uniform in u
TINY = 1e-30
FLAT, STEEP = 1e-3, 8.0  # bounds of a slope


@dataclass(frozen=True)
class Batch:
    """Cells (B, S) of B groups: y = G/B(r) as traced and its noise; and queries (B, 2 S), two points of each cell."""

    y: torch.Tensor
    hit: torch.Tensor  # value that one score adds to y
    u: torch.Tensor  # first the first points of all cells, then the second ones, as in what follows
    r: torch.Tensor
    psi: torch.Tensor  # azimuth of x_o - x_i from the forward direction
    mu_i: torch.Tensor  # cosines inside
    mu_o: torch.Tensor
    delta_phi: torch.Tensor
    L: torch.Tensor
    index: torch.Tensor  # group of each row
    medium: torch.Tensor  # features of the medium (B, N_MEDIUM)

    def features(self) -> torch.Tensor:
        """Symmetric features (B, 2 S, N_FEATURES)."""
        incoming, outgoing = _ray(self.mu_i, -self.psi), _ray(self.mu_o, self.delta_phi - self.psi)
        lib = torch_library()
        return torch.stack(torch.broadcast_tensors(*symmetric_features(lib, self.r, incoming, outgoing, self.L)), -1)


def _ray(mu: torch.Tensor, azimuth: torch.Tensor) -> tuple[torch.Tensor, ...]:
    sine = torch.sqrt((1 - mu * mu).clamp_min(0.0))
    return sine * torch.cos(azimuth), sine * torch.sin(azimuth), mu


def torch_library() -> Library:
    return library(torch.empty(0))


class MapPool:
    """Maps of many groups as ratios to the backbone, ready to be drawn from.
    `groups`, `grid`: what was traced. `halves`: cell integrals of G, shape (n, 2, 16, n_u, n_psi), two independent
    estimates."""

    def __init__(self, groups: Groups, grid: CellGrid, halves: np.ndarray) -> None:
        self.groups = groups
        self.grid = grid
        mass = np.maximum(backbone_mass(groups, grid), TINY)
        mean = halves.mean(axis=1)
        self.y: torch.Tensor = torch.from_numpy((mean / mass[:, None, :, None]).astype(np.float32)).contiguous()
        difference = (halves[:, 0] - halves[:, 1]).astype(np.float64)
        hit = (difference**2).sum(axis=(1, 2, 3)) / np.maximum(4 * mean.sum(axis=(1, 2, 3), dtype=np.float64), TINY)
        self.hit: torch.Tensor = _float(hit[:, None] / mass)
        energy = mean.sum(axis=(1, 3), dtype=np.float64)
        energy = _smooth(energy) / np.maximum(energy.sum(axis=1, keepdims=True), TINY)
        share = ENERGY_SHARE * energy + (1 - ENERGY_SHARE) / grid.n_u
        self.cdf: torch.Tensor = _float(np.cumsum(share / share.sum(axis=1, keepdims=True), axis=1))
        slope = np.gradient(np.log(mass), axis=1)  # of the weight of a point within its cell, over the cell
        self.slope: torch.Tensor = _float(np.where(np.abs(slope) < FLAT, FLAT, np.clip(slope, -STEEP, STEEP)))
        edges = radial_edges(groups, grid)
        self.low: torch.Tensor = _float(edges[:, :1])
        self.step: torch.Tensor = _float(edges[:, 1:2] - edges[:, :1])
        self.mu_i: torch.Tensor = _inside(groups.mu_i[:, None], groups)
        self.mu_o: torch.Tensor = _inside(groups.mu_o, groups)
        self.delta_phi: torch.Tensor = _float(groups.delta_phi)
        albedo, g, eta = (_float(v) for v in (groups.albedo, groups.g, groups.eta))
        L = length_scale(albedo, g)
        self.L: torch.Tensor = L[:, None]
        self.medium: torch.Tensor = torch.stack(medium_features(torch_library(), albedo, g, eta, L), -1)

    def batches(self, n_groups: int, n_queries: int) -> Callable[[torch.Generator], Batch]:
        """The source of a fit: `batch` of one size."""
        return lambda generator: self.batch(n_groups, n_queries, generator)

    def batch(self, n_groups: int, n_queries: int, generator: torch.Generator) -> Batch:
        """Random cells, and two points in each, with the weight B r dr/du that the mean over the cell gives them.
        The weight is taken as exponential in u within a cell. See `learners.cell_loss` for why two."""
        n_psi = self.grid.n_psi
        shape = (n_groups, n_queries)

        def uniform(points: int = 1) -> torch.Tensor:
            return torch.rand((n_groups, points * n_queries), generator=generator)

        j = torch.randint(len(self.groups), (n_groups,), generator=generator)
        k = torch.randint(self.mu_o.shape[1], shape, generator=generator)
        i = torch.searchsorted(self.cdf[j].contiguous(), uniform()).clamp_max(self.grid.n_u - 1)
        p = torch.randint(n_psi, shape, generator=generator)
        y = self.y.view(-1)[((j[:, None] * self.mu_o.shape[1] + k) * self.grid.n_u + i) * n_psi + p]
        row = j[:, None]
        slope = self.slope[row, i]
        slopes = torch.cat((slope, slope), dim=1)
        inner = torch.log1p(uniform(2) * torch.expm1(slopes)) / slopes
        u = self.low[j] + self.step[j] * (torch.cat((i, i), dim=1) + inner)
        psi = (2 * math.pi / n_psi) * (torch.cat((p, p), dim=1) + uniform(2)) - math.pi
        twice = torch.cat((k, k), dim=1)
        L = self.L[j]
        r = L * unwarp(torch_library(), u)
        return Batch(
            y=y, hit=self.hit[row, i], u=u, r=r, psi=psi, mu_i=self.mu_i[j], mu_o=self.mu_o[row, twice],
            delta_phi=self.delta_phi[row, twice], L=L, index=j, medium=self.medium[j],
        )  # fmt: skip


def _float(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _inside(mu: np.ndarray, groups: Groups) -> torch.Tensor:
    eta = groups.eta[:, None]
    return _float(np.sqrt(np.maximum(1 - (1 - mu**2) / eta**2, 1e-8)))


def _smooth(energy: np.ndarray) -> np.ndarray:
    """Mean over five neighbours in u: the noise of a map must not decide where it is looked at."""
    padded = np.pad(energy, ((0, 0), (2, 2)), mode="edge")
    return sum(padded[:, k : k + energy.shape[1]] for k in range(5)) / 5


def cell_loss(p: torch.Tensor, y: torch.Tensor, weight: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    """A loss whose gradient is h(p_1) ∇p_1 (p_2 - y) + h(p_2) ∇p_2 (p_1 - y) for independent points of a cell.

    y is the mean over the cell: the expectation of the gradient is that of its squared error, E[h ∇p] (E[p] - y),
    whatever the weight h. The squared error of single points would add the variance within the cell and so flatten
    what is learnt.

    Args:
        p: (B, 2 S), the first points of all cells and then the second ones.
        y: (B, S).
        weight: h of p without gradient, for points (B, 2 S).
    """
    p_1, p_2 = p.detach().chunk(2, dim=1)
    slope = weight(p.detach()) * torch.cat((p_2 - y, p_1 - y), dim=1)
    error = (slope.detach() * (p - p.detach())).mean()
    return error + ((p_1 - y) * (p_2 - y) * weight(p.detach()).chunk(2, dim=1)[0]).mean().detach()


def relative_loss(p: torch.Tensor, batch: Batch) -> torch.Tensor:
    """Mean of (p - y)² / (p² + p hit), the denominator held fixed; its minimum is unbiased for noisy y.
    p hit is the variance of y where few scores have met a cell, so that those cells count by their noise and the others
    by their relative error."""
    hit = torch.cat((batch.hit, batch.hit), dim=1)
    return cell_loss(p, batch.y, lambda q: 1 / (q * (q + hit) + 1e-20))


def initial_numbers(shapes: list[tuple[int, int]], generator: torch.Generator) -> torch.Tensor:
    """Numbers of a network at the start: He scaling, a tenth of it in the last layer, biases zero."""
    parts = []
    for k, (n_in, n_out) in enumerate(shapes):
        gain = math.sqrt((1.0 if k == 0 else 1.5) / n_in) * (0.1 if n_out == 1 else 1.0)
        parts += [gain * torch.randn(n_in * n_out, generator=generator), torch.zeros(n_out)]
    return torch.cat(parts)


def apply_networks(
    h: torch.Tensor,
    numbers: torch.Tensor,
    shapes: list[tuple[int, int]],
    activation: Callable[[torch.Tensor], torch.Tensor] = nn.functional.silu,
) -> torch.Tensor:
    """Networks of rows `numbers` (B, P) on features (B, S, n_in); gives (B, S)."""
    parts = torch.split(numbers, [n for i, j in shapes for n in (i * j, j)], dim=1)
    for k, (i, j) in enumerate(shapes):
        h = torch.baddbmm(parts[2 * k + 1][:, None], h, parts[2 * k].view(-1, i, j))
        if k < len(shapes) - 1:
            h = activation(h)
    return h[..., 0]


class Small(nn.Module):
    """log(G/B) of one medium: `Network` as a torch module.
    `seed`: of the numbers at the start. `start`: network to start from instead."""

    depth = 3

    def __init__(self, width: int = 32, seed: int = 0, start: Network | None = None) -> None:
        super().__init__()
        self.width = width
        self.shapes: list[tuple[int, int]] = layer_shapes(N_FEATURES, width, self.depth)
        numbers = initial_numbers(self.shapes, torch.Generator().manual_seed(seed))
        if start is not None:
            pairs = zip(start.matrices, start.biases)
            numbers = torch.cat([torch.from_numpy(np.copy(v)).flatten() for pair in pairs for v in pair])
        self.numbers: nn.Parameter = nn.Parameter(numbers)

    def loss(self, batch: Batch) -> torch.Tensor:
        features = batch.features().flatten(0, 1)[None]
        p = torch.exp(apply_networks(features, self.numbers[None], self.shapes).clamp(-LOG_RANGE, LOG_RANGE))
        return relative_loss(p.view_as(batch.u), batch)

    def network(self) -> Network:
        return Network.from_vector(self.numbers.detach().numpy(), self.shapes)


class PaperLearner(nn.Module):
    """S of one medium by a plain perceptron: `NeuralPaper` as a torch module.
    `medium`: scalar, in mean free paths. `scale`: S is divided by it, so that targets are of order one. `seed`: of the
    numbers at the start."""

    depth = 3

    def __init__(self, medium: Medium, scale: float, width: int = 256, seed: int = 0) -> None:
        super().__init__()
        self.medium = medium
        self.scale = scale
        self.width = width
        self.shapes: list[tuple[int, int]] = layer_shapes(N_INPUTS, width, self.depth)
        self.numbers: nn.Parameter = nn.Parameter(initial_numbers(self.shapes, torch.Generator().manual_seed(seed)))

    def inputs(self, batch: Batch) -> torch.Tensor:
        """The six inputs, each batch seen under a random azimuth of incidence, (B, S, 6)."""
        # drawn from the batch itself, so that the checkpointed generator decides it
        turn = 2 * math.pi * torch.frac(1e4 * batch.psi)
        sines = [self.medium.eta * torch.sqrt((1 - mu * mu).clamp_min(0.0)) for mu in (batch.mu_i, batch.mu_o)]
        # forward is the horizontal direction of travel: w_i points the other way
        w_i, w_o = (sines[0], turn + math.pi), (sines[1], turn + batch.delta_phi)
        parts = paper_inputs(library(batch.r), batch.r, turn + batch.psi, w_i, w_o, batch.L)
        return torch.stack(torch.broadcast_tensors(*parts), dim=-1)

    def S_over_y(self, batch: Batch) -> torch.Tensor:
        """What turns the ratio y = G/B into S / scale."""
        m = self.medium
        B = backbone(batch.r, float(m.albedo), float(m.g), m.eta)
        outside = [torch.sqrt((1 - m.eta**2 * (1 - mu * mu)).clamp_min(0.0)) for mu in (batch.mu_i, batch.mu_o)]
        return B * F_t(outside[0], m.eta) * F_t(outside[1], m.eta) / self.scale

    def loss(self, batch: Batch) -> torch.Tensor:
        S = apply_networks(self.inputs(batch).flatten(0, 1)[None], self.numbers[None], self.shapes, torch.relu)
        S_1, S_2 = S.view_as(batch.u).chunk(2, dim=1)
        scale_1, scale_2 = self.S_over_y(batch).chunk(2, dim=1)
        # as `cell_loss` of S / scale with the weight scale_1 scale_2, but scale may be 0
        return ((S_1 - scale_1 * batch.y) * (S_2 - scale_2 * batch.y)).mean()

    def network(self) -> Network:
        return Network.from_vector(self.numbers.detach().numpy(), self.shapes, RELU)
