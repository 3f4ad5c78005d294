"""Energies of a model in the cells of traced maps, by quadrature that is refined until the numbers stand."""

from __future__ import annotations

import math

import numpy as np

from halfspace_sss.arrays import library
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.maps.noisy_maps import CellGrid, Groups, radial_edges
from halfspace_sss.physics.backbone import unwarp

N_U, FIRST_N_PSI, LAST_N_PSI = 2, 6, 48  # Gauss points of a cell
BRIGHT = 4  # directions of observation, of 16, on which convergence is tried
CONVERGED = 3e-3  # of their energy
LANES = 2**21


def cell_energies(model: BSSRDF, groups: Groups, grid: CellGrid) -> np.ndarray:
    """∫ S mu_i mu_o dA over each cell, shape (n, 16, n_u, n_psi).

    Where light is scattered forwards, S has ridges in azimuth that are much narrower than a cell: for each direction
    of incidence the points in psi are doubled until the cells of the four brightest directions of observation change
    by less than 0.3 % of their energy.

    Args:
        model: made for the medium of all groups, with lengths in mean free paths; evaluated in single precision.
        groups, grid: directions and cells.
    """
    rows, columns = np.arange(len(groups))[:, None], np.arange(groups.mu_o.shape[1])[None]
    cells = _at(model, groups, grid, rows, columns, FIRST_N_PSI)
    n_psi = FIRST_N_PSI
    while rows.size and n_psi < LAST_N_PSI:
        n_psi *= 2
        order = np.argsort(-cells[rows[:, 0]].sum(axis=(2, 3)), axis=1)
        bright, others = order[:, :BRIGHT], order[:, BRIGHT:]
        finer = _at(model, groups, grid, rows, bright, n_psi)
        change = np.abs(finer - cells[rows, bright]).sum(axis=(1, 2, 3))
        cells[rows, bright] = finer
        changed = change > CONVERGED * finer.sum(axis=(1, 2, 3))
        rows, others = rows[changed], others[changed]
        if rows.size:
            cells[rows, others] = _at(model, groups, grid, rows, others, n_psi)
    return cells


def _at(model: BSSRDF, groups: Groups, grid: CellGrid, rows: np.ndarray, columns: np.ndarray, n_psi: int) -> np.ndarray:
    """The cells of some directions of incidence (n, 1) and of observation (n or 1, m)."""
    columns = np.broadcast_to(columns, (len(rows), columns.shape[1]))
    size = grid.n_u * grid.n_psi * N_U * n_psi * columns.size
    n = max(1, min(len(rows), size // LANES))
    parts = zip(np.array_split(rows, n), np.array_split(columns, n))
    return np.concatenate([_part(model, groups, grid, *part, n_psi) for part in parts])


def _part(
    model: BSSRDF, groups: Groups, grid: CellGrid, rows: np.ndarray, columns: np.ndarray, n_psi: int
) -> np.ndarray:
    u, u_weight = _points(radial_edges(groups, grid)[rows[:, 0]], N_U)
    psi, psi_weight = _points(np.linspace(-math.pi, math.pi, grid.n_psi + 1), n_psi)
    L = groups.L[rows]
    r = L * unwarp(library(0.0), u)
    area = (r * L / (1 + np.exp(-u)) * u_weight)[:, None, :, None] * psi_weight
    mu_i, mu_o = groups.mu_i[rows][..., None, None], groups.mu_o[rows, columns][..., None, None]
    phi_o = groups.delta_phi[rows, columns][..., None, None] - psi
    S = evaluated(model, (r[:, None, :, None], mu_i, math.pi - psi, mu_o, phi_o))
    E = S * area * mu_i * mu_o
    return E.reshape(*E.shape[:2], grid.n_u, N_U, grid.n_psi, n_psi).sum(axis=(3, 5))


def evaluated(model: BSSRDF, query: tuple[np.ndarray, ...]) -> np.ndarray:
    """S of NumPy arrays in single precision, in the library that is fastest for the model; the result in double."""
    query = np.broadcast_arrays(*(np.asarray(v, np.float32) for v in query))
    if model.fast_in == "drjit":
        from drjit.llvm import Float

        S = np.asarray(model.eval(*(Float(v.ravel()) for v in query)))
    else:
        S = model.eval(*query)
    return np.asarray(S, np.float64).reshape(query[0].shape)


def _points(edges: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights of the intervals between edges, along the last axis."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    half = 0.5 * np.diff(edges)[..., None]
    middle = 0.5 * (edges[..., 1:] + edges[..., :-1])[..., None]
    flat = (*edges.shape[:-1], -1)
    return (middle + half * nodes).reshape(flat), (half * weights).reshape(flat)
