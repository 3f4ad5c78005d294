"""How wrong a model is against path tracing: energy-weighted relative L1 over unseen pairs of directions.

error = sum |E_model - E_traced| / sum E_traced, E = ∫ S mu_i mu_o dA over blocks of cells, order >= 2; the noise of the
reference, known from two independent halves, is taken out: sqrt(error² - noise²). The number depends on the size of the
blocks, which is stated with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from halfspace_sss.arrays import library
from halfspace_sss.executors import completed
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.maps.noisy_maps import LEAST_ALBEDO, CellGrid, Groups, make_pool, radial_edges
from halfspace_sss.measure.reflected_flux import evaluated
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.physics.backbone import unwarp
from halfspace_sss.physics.fresnel import F_t, mu_internal
from halfspace_sss.physics.medium import Medium, eval_hg
from halfspace_sss.progress import NamedProgress
from halfspace_sss.registry import models, models_of

if TYPE_CHECKING:
    import pandas


# ---- Energies of a model in the cells of traced maps, by quadrature that is refined until the numbers stand ----

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
    S = in_single(model, (r[:, None, :, None], mu_i, math.pi - psi, mu_o, phi_o))
    E = S * area * mu_i * mu_o
    return E.reshape(*E.shape[:2], grid.n_u, N_U, grid.n_psi, n_psi).sum(axis=(3, 5))


def in_single(model: BSSRDF, query: tuple[np.ndarray, ...]) -> np.ndarray:
    """`evaluated` in single precision."""
    return evaluated(model, tuple(np.asarray(v, np.float32) for v in query))


def _points(edges: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights of the intervals between edges, along the last axis."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    half = 0.5 * np.diff(edges)[..., None]
    middle = 0.5 * (edges[..., 1:] + edges[..., :-1])[..., None]
    flat = (*edges.shape[:-1], -1)
    return (middle + half * nodes).reshape(flat), (half * weights).reshape(flat)


# ---- Errors against traced maps ----

SET = 8  # directions of a set, each towards each at two azimuths


class ModelError(NamedTuple):
    """Relative errors: noise removed, as measured, the noise, the signed error of the energy and its own noise.

    `square` is that of the error before it is cut off at 0, with the standard error of what other directions of
    incidence and other walks would have given.
    """

    error: float
    raw: float
    noise: float
    bias: float
    bias_noise: float
    by_decade: dict[str, float]
    square: float
    square_error: float

    @property
    def known(self) -> NoiseFree:
        return NoiseFree(self.square, self.square_error)


@dataclass(frozen=True, eq=False)
class TracedMaps:
    """Traced maps of one medium: groups of directions, cells, two independent estimates of ∫ G dA per cell.

    Args:
        medium: scalar medium in mean free paths.
        groups, grid: directions and cells.
        halves: (n, 2, 16, n_u, n_psi).
        block: cells of u and of psi that are put together before the comparison.
    """

    medium: Medium
    groups: Groups
    grid: CellGrid
    halves: np.ndarray
    block: int

    def energies(self) -> np.ndarray:
        """∫ S mu_i mu_o dA of each block in both halves, (n, 2, 16, n_u / block, n_psi / block)."""
        weight = _weight(self.groups.mu_i, self.medium.eta)[:, None] * _weight(self.groups.mu_o, self.medium.eta)
        albedo = float(self.medium.albedo)
        weight *= (albedo / max(albedo, LEAST_ALBEDO)) ** 2  # darker media were traced at that albedo
        return self._blocks(self.halves.astype(np.float64) * weight[:, None, :, None, None])

    def _blocks(self, cells: np.ndarray) -> np.ndarray:
        b = self.block
        n_u, n_psi = (n // b for n in cells.shape[-2:])
        return cells[..., : n_u * b, : n_psi * b].reshape(*cells.shape[:-2], n_u, b, n_psi, b).sum(axis=(-3, -1))

    def model_energies(self, model: BSSRDF) -> np.ndarray:
        """The same of a model, by quadrature; (n, 16, ...)."""
        return self._blocks(cell_energies(model, self.groups, self.grid))

    def single_energies(self) -> np.ndarray:
        """The same of single scattering, exactly: a line of each pair of directions, (n, 16, ...)."""
        groups, m = self.groups, self.medium
        mu_i = mu_internal(groups.mu_i, m.eta)[:, None]
        mu_o, phi = mu_internal(groups.mu_o, m.eta), groups.delta_phi
        sin_i, sin_o = np.sqrt(1 - mu_i**2), np.sqrt(1 - mu_o**2)
        # a ray that scatters after a path s leaves at s v and has gone on for s mu_i / mu_o
        ratio = mu_i / mu_o
        v_x, v_y = sin_i + ratio * sin_o * np.cos(phi), ratio * sin_o * np.sin(phi)
        p = eval_hg(sin_i * sin_o * np.cos(phi) - mu_i * mu_o, m.g)
        r = groups.L[:, None] * unwarp(library(0.0), radial_edges(groups, self.grid))
        s = r[:, None, :] / np.maximum(np.hypot(v_x, v_y), 1e-12)[..., None]
        share = -np.diff(np.exp(-(1 + ratio)[..., None] * s), axis=-1)
        weight = _weight(groups.mu_i, m.eta)[:, None] * _weight(groups.mu_o, m.eta)
        E = (weight * m.albedo * p / (m.eta**2 * (mu_i + mu_o)))[..., None] * share
        n_psi = self.grid.n_psi
        column = np.floor((np.arctan2(v_y, v_x) / (2 * math.pi) + 0.5) * n_psi).astype(int) % n_psi
        cells = np.zeros((*E.shape, n_psi))
        np.put_along_axis(cells, np.broadcast_to(column[..., None, None], (*E.shape, 1)), E[..., None], axis=-1)
        return self._blocks(cells)

    def block_radii(self) -> np.ndarray:
        """Distance in the middle of each row of blocks, mean free paths, (n, n_u / block)."""
        edges = radial_edges(self.groups, self.grid)[:, :: self.block]
        return self.groups.L[:, None] * unwarp(library(0.0), 0.5 * (edges[:, 1:] + edges[:, :-1]))


def _weight(mu: np.ndarray, eta: float) -> np.ndarray:
    return mu * F_t(mu, eta)


def model_error(model: BSSRDF, reference: TracedMaps, within: tuple[float, float] | None = None) -> ModelError:
    """Error of a model against traced maps of its medium, at the orders of the model; see the module.

    Args:
        model: made for `reference.medium`. Where it contains single scattering the exact one is added to the maps.
        reference: traced with seeds that the model was not trained with.
        within: smallest and largest distance that counts, mean free paths; by default all.
    """
    # energies of both halves of the reference and of the model in blocks of cells
    halves, E = reference.energies(), reference.model_energies(model)
    if within is not None:
        radii = reference.block_radii()
        counts = ((radii >= within[0]) & (radii <= within[1]))[:, None, :, None]
        halves, E = halves * counts[:, None], E * counts
    traced = halves.mean(axis=1)
    if model.orders == "total":
        traced = traced + reference.single_energies() * (1 if within is None else counts)
    total = float(traced.sum() or E.sum() or 1.0)  # a medium that does not scatter has none
    # raw = sum |E - E_t| / sum E_t, and the same of half the difference of the halves, which is noise alone
    deviation, noise = np.abs(E - traced), 0.5 * np.abs(halves[:, 0] - halves[:, 1])
    raw, blur = float(deviation.sum() / total), float(noise.sum() / total)
    bias_noise = float(0.5 * abs(halves[:, 0].sum() - halves[:, 1].sum()) / total)
    # the error of each decade of r, noise taken out: sqrt(raw² - noise²)
    decades = {}
    decade = np.floor(np.log10(reference.block_radii())).astype(int)
    for d in np.unique(decade):
        rows = np.broadcast_to((decade == d)[:, None, :, None], traced.shape)
        share = traced[rows].sum()
        if share > 1e-4 * total:
            square = float(deviation[rows].sum()) ** 2 - float(noise[rows].sum()) ** 2
            decades[f"{10.0**d:g}-{10.0 ** (d + 1):g}"] = math.sqrt(max(square, 0.0)) / float(share)
    bias, parts = float((E.sum() - traced.sum()) / total), (deviation, noise, traced if traced.any() else E)
    known = _known(*(np.asarray(part.sum(axis=(1, 2, 3)), np.float64) for part in parts))
    return ModelError(known.value, raw, blur, bias, bias_noise, decades, *known)


def _known(deviation: np.ndarray, noise: np.ndarray, energy: np.ndarray) -> NoiseFree:
    """(sum deviation / sum energy)² - (sum noise / sum energy)² of directions of incidence, and its standard error.
    By the jackknife over the directions; twice the variance, as each pair of them stands in the maps of both."""

    def square(*sums: float | np.ndarray) -> float | np.ndarray:
        a, b, total = sums
        return (a * a - b * b) / np.where(total > 0, total, 1.0) ** 2

    sums, n = [v.sum() for v in (deviation, noise, energy)], len(energy)
    if n < 2:
        return NoiseFree(float(square(*sums)), math.inf)
    left_out = square(*(total - v for total, v in zip(sums, (deviation, noise, energy))))
    spread = 2 * (n - 1) / n * np.sum((left_out - left_out.mean()) ** 2)
    return NoiseFree(float(square(*sums)), math.sqrt(float(spread)))


def _reciprocal_directions(medium: Medium, n_sets: int, n_psi: int, rng: np.random.Generator) -> Groups:
    """Sets of 8 cosines, every pair at two azimuths that are whole numbers of cells: each pair also runs backwards."""
    lowest = math.sqrt(max(1 - medium.eta**2, 0.0))
    mu, turns = [], []
    for _ in range(n_sets):
        mu.append(lowest + (1 - lowest) * (rng.permutation(SET) + rng.random(SET)) / SET)
        m = rng.integers(0, n_psi, (2, SET, SET))
        m = np.triu(m, 1) - np.swapaxes(np.triu(m, 1), 1, 2)
        m[:, range(SET), range(SET)] = np.array([[0], [n_psi // 2]])
        turns.append(np.moveaxis(m, 0, -1).reshape(SET, 2 * SET))
    one = np.ones(n_sets * SET)
    mu_o = np.repeat(np.repeat(np.stack(mu), 2, axis=1)[:, None], SET, axis=1).reshape(-1, 2 * SET)
    ratios = (float(medium.albedo) * one, float(medium.g) * one, medium.eta * one)
    return Groups(*ratios, np.concatenate(mu), mu_o, 2 * math.pi / n_psi * np.concatenate(turns))


def _mean_of_both_ways(groups: Groups, halves: np.ndarray) -> np.ndarray:
    """G of each pair from the maps both ways, (M(i, o; psi) + M(o, i; psi - delta_phi)) / 2."""
    n_psi = halves.shape[-1]
    sets = halves.reshape(-1, SET, 2, SET, 2, *halves.shape[-2:])  # set, k, half, j, azimuth, u, psi
    back = np.swapaxes(sets, 1, 3)
    turns = np.rint(groups.delta_phi * n_psi / (2 * math.pi)).astype(int).reshape(-1, SET, SET, 2)
    psi = (np.arange(n_psi) - turns[..., None]) % n_psi  # set, k, j, azimuth, psi
    psi = psi[:, :, None, :, :, None, :]
    rolled = np.take_along_axis(back, np.broadcast_to(psi, back.shape), axis=-1)
    return (0.5 * (sets + rolled)).reshape(halves.shape)


class ReferenceSize(NamedTuple):
    """Sets of 8 directions, the cells of their maps, and cells of u and of psi that are compared together."""

    n_sets: int
    grid: CellGrid
    block: int


def reference_maps(
    media: list[Medium],
    size: ReferenceSize,
    events: float,
    seed: tuple[int, ...],
    progress: NamedProgress | None = None,
    backend: str = "llvm",
    executor: Executor | None = None,
) -> list[TracedMaps]:
    """Traced maps of scalar media, each with n_sets times 8 directions of incidence times 16 of observation.

    Args:
        media: scalar media; lengths are mean free paths of each.
        size: sets of directions, cells and blocks.
        events: scattering events over all media.
        seed: must differ from that of any training.
        executor: where launches run (see `halfspace_sss.executors`); by default in this process.
    """
    rng, (n_sets, grid, block) = np.random.default_rng(list(seed)), size
    parts = [_reciprocal_directions(m, n_sets, grid.n_psi, rng) for m in media]
    columns = (np.concatenate([getattr(p, n) for p in parts]) for n in Groups.__dataclass_fields__)
    halves = make_pool(
        Groups(*columns), grid, events, (*seed, 1), folder=None, progress=progress, backend=backend, executor=executor
    )
    n = n_sets * SET
    maps = [_mean_of_both_ways(p, halves[k * n : (k + 1) * n]) for k, p in enumerate(parts)]
    return [TracedMaps(m.in_mfp(), p, grid, h, block) for m, p, h in zip(media, parts, maps)]


HELD_OUT_SEED = 15485863
GRID, BLOCK = CellGrid(40, 16), 4


def references(
    media: list[Medium], events: float, seed: int = 0, block: int = BLOCK,
    progress: NamedProgress | None = None, backend: str = "llvm", executor: Executor | None = None,
) -> list[TracedMaps]:  # fmt: skip
    """Traced maps of the media: 128 unseen pairs of directions each, `events` over all."""
    size = ReferenceSize(1, GRID, block)
    return reference_maps(media, size, events, (HELD_OUT_SEED, seed), progress, backend, executor)


def error_table(
    labels: Iterable[str],
    maps: list[TracedMaps],
    names: Iterable[str] | None = None,
    progress: NamedProgress | None = None,
    executor: Executor | None = None,
) -> pandas.DataFrame:
    """One row per medium and model that accepts it: error, noise, bias (fractions), error by decade of r in mfp.

    Args:
        labels: of the media, each another one.
        maps: of the media, in that order.
        names: of models; by default all.
        progress: called with ("models", media done, media in all).
        executor: where media are compared (see `halfspace_sss.executors`); by default in this process.
    """
    import pandas

    chosen = list(names or models())
    parts = {label: (label, reference, chosen) for label, reference in zip(labels, maps)}
    rows: dict[str, list[dict[str, float | str]]] = {}
    for label, result in completed(executor, _rows, parts):
        rows[label] = result
        if progress:
            progress("models", len(rows), len(parts))
    return pandas.DataFrame([row for label in parts for row in rows[label]])


def _rows(label: str, reference: TracedMaps, names: list[str]) -> list[dict[str, float | str]]:
    """Of one medium, a row for each model that accepts it."""
    rows, m = [], reference.medium
    for model in models_of(m, names):
        e = model_error(model, reference)
        row = {"medium": label, "albedo": float(m.albedo), "g": float(m.g), "eta": m.eta, "model": model.name}
        row |= {"orders": model.orders, "error": e.error, "error_square": e.square}
        row |= {"error_square_standard_error": e.square_error, "raw": e.raw, "noise": e.noise, "bias": e.bias}
        rows.append(row | {"bias_noise": e.bias_noise} | {f"r {d}": v for d, v in e.by_decade.items()})
    return rows


def percentiles(table: pandas.DataFrame) -> pandas.DataFrame:
    """Per model: media, median, 90th percentile and largest error with its medium, median of |bias|."""
    import pandas

    rows = []
    for name, t in table.groupby("model", sort=False):
        worst = t.loc[t["error"].idxmax()]
        row = {"model": name, "orders": worst["orders"], "media": len(t), "median": t["error"].median()}
        row |= {"p90": t["error"].quantile(0.9), "worst": worst["error"], "worst_medium": worst["medium"]}
        rows.append(row | {"median_abs_bias": t["bias"].abs().median(), "median_noise": t["noise"].median()})
    return pandas.DataFrame(rows)
