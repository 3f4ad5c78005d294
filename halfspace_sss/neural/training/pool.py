"""A pool of noisy maps in memory, and random batches of queries from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from halfspace_sss.arrays import Library, library
from halfspace_sss.maps.noisy_maps import CellGrid, Groups, backbone_mass, radial_edges
from halfspace_sss.neural.features import medium_features, symmetric_features
from halfspace_sss.physics.backbone import length_scale, unwarp

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
    """The array library of torch."""
    return library(torch.empty(0))


class MapPool:
    """Maps of many groups as ratios to the backbone, ready to be drawn from.

    Args:
        groups, grid: what was traced.
        halves: cell integrals of G, shape (n, 2, 16, n_u, n_psi), two independent estimates.
    """

    def __init__(self, groups: Groups, grid: CellGrid, halves: np.ndarray) -> None:
        self.groups, self.grid = groups, grid
        mass = np.maximum(backbone_mass(groups, grid), TINY)
        mean = halves.mean(axis=1)
        self.y = torch.from_numpy((mean / mass[:, None, :, None]).astype(np.float32)).contiguous()
        difference = (halves[:, 0] - halves[:, 1]).astype(np.float64)
        hit = (difference**2).sum(axis=(1, 2, 3)) / np.maximum(4 * mean.sum(axis=(1, 2, 3), dtype=np.float64), TINY)
        self.hit = _float(hit[:, None] / mass)
        energy = mean.sum(axis=(1, 3), dtype=np.float64)
        energy = _smooth(energy) / np.maximum(energy.sum(axis=1, keepdims=True), TINY)
        share = ENERGY_SHARE * energy + (1 - ENERGY_SHARE) / grid.n_u
        self.cdf = _float(np.cumsum(share / share.sum(axis=1, keepdims=True), axis=1))
        slope = np.gradient(np.log(mass), axis=1)  # of the weight of a point within its cell, over the cell
        self.slope = _float(np.where(np.abs(slope) < FLAT, FLAT, np.clip(slope, -STEEP, STEEP)))
        edges = radial_edges(groups, grid)
        self.low, self.step = _float(edges[:, :1]), _float(edges[:, 1:2] - edges[:, :1])
        self.mu_i, self.mu_o = _inside(groups.mu_i[:, None], groups), _inside(groups.mu_o, groups)
        self.delta_phi = _float(groups.delta_phi)
        albedo, g, eta = (_float(v) for v in (groups.albedo, groups.g, groups.eta))
        L = length_scale(albedo, g)
        self.L = L[:, None]
        self.medium = torch.stack(medium_features(torch_library(), albedo, g, eta, L), -1)

    def batches(self, n_groups: int, n_queries: int) -> Callable[[torch.Generator], Batch]:
        """The source of a fit: `batch` of one size."""
        return lambda generator: self.batch(n_groups, n_queries, generator)

    def batch(self, n_groups: int, n_queries: int, generator: torch.Generator) -> Batch:
        """Random cells, and two points in each, with the weight B r dr/du that the mean over the cell gives them.

        The weight is taken as exponential in u within a cell. See `learners.cell_loss` for why two.
        """
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
