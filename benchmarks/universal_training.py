"""Training of the network for all media: maps of many media, a fit, and a fit of `calibration` to exact reflectances.

For each medium, at some cosines of incidence, are known the exact R of all orders (discrete ordinates), that of the
single order, and the flux of the network towards 40 intervals of cosines of exit. The coefficients of a follow from the
medium by a network whose loss is the squared logarithm of a(mu_i) sum_b flux_b a(mu_b) and the single order over R. It
aims below R where that is close to 1, by about its error, so that no light is made.
"""

from __future__ import annotations

import io
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.comparison.sampled_exits import exits
from halfspace_sss.maps.noisy_maps import CellGrid, Groups, draw_directions, load_maps, make_pool
from halfspace_sss.neural.network import (
    GRAZING,
    LOG_RANGE,
    N_FEATURES,
    N_MEDIUM,
    N_POLYNOMIALS,
    N_TERMS,
    layer_shapes,
    medium_features,
)
from halfspace_sss.neural.store import save_weights
from halfspace_sss.neural.training.fit import CHECKPOINT, Fit, claim, fit
from halfspace_sss.neural.training.learners import (
    Batch,
    MapPool,
    apply_networks,
    initial_numbers,
    relative_loss,
    torch_library,
)
from halfspace_sss.neural.training.train_material import Trial
from halfspace_sss.neural.universal import CALIBRATION, RANGES, Hypernetwork, Layers, hypernetwork_of
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.backbone import length_scale
from halfspace_sss.physics.fresnel import mu_internal
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import JsonDict, check_folder, provenance, write_atomically

INTERVALS, STEEPNESS = 40, 1.7  # of the cosine of exit, and the power by which they are narrow near the horizon
COSINES = 6  # of incidence, of each medium, as close there
STEEP = 0.6  # of the media have g as in (0.86, 0.98) and, nearly half of them, eta = 1: there the network is weakest
LEAST_ALBEDO = 0.05  # below it R of order >= 2 drowns in the rounding of both orders; a goes on as it is there
POINTS, REPEATS = 2048, 4  # of a proposal; scrambles
NOISY, MORE = 3e-3, 8  # relative error above which a medium gets more points, and how many times as many
TRUSTED = 3e-3  # relative error that counts in full
BELOW, BRIGHT = 5e-3, 0.03  # part of R by which it is undercut where it is 1; from 1 - BRIGHT on
OUTLIER = 0.03  # of a logarithm, from which on it counts linearly
WIDTH, HIDDEN = 64, 3
CHUNK = 64  # media of a file
N_BACK = 2  # observations of a group that look back along the incident ray
BACK = (-3.0, math.log10(0.3))  # exponents of their distance from it
MEDIUM_WIDTH = 64  # hidden units of the network of a medium, which has two hidden layers


class Hyper(nn.Module):
    """log(G/B) of any medium: `Hypernetwork` as a torch module.
    `rank`: number of coefficients of a medium. `seed`: of the numbers at the start."""

    width, depth = 32, 3  # hidden layers of the small network it writes

    def __init__(self, rank: int = 48, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.shapes: list[tuple[int, int]] = layer_shapes(N_FEATURES, self.width, self.depth)
        sizes = [N_MEDIUM, MEDIUM_WIDTH, MEDIUM_WIDTH, rank]
        self.matrices: nn.ParameterList = nn.ParameterList(
            torch.randn(i, j, generator=generator) / math.sqrt(i) for i, j in zip(sizes, sizes[1:])
        )
        self.biases: nn.ParameterList = nn.ParameterList(0.1 * torch.randn(j, generator=generator) for j in sizes[1:])
        self.base: nn.Parameter = nn.Parameter(initial_numbers(self.shapes, generator))
        scale = torch.cat([torch.full((i * j + j,), 1 / math.sqrt(i)) for i, j in self.shapes])
        self.basis: nn.Parameter = nn.Parameter(
            0.5 / math.sqrt(rank) * scale * torch.randn(rank, len(scale), generator=generator)
        )

    def loss(self, batch: Batch) -> torch.Tensor:
        c = batch.medium
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            c = torch.addmm(b, c, W)
            if k < len(self.matrices) - 1:
                c = nn.functional.silu(c)
        log_factor = apply_networks(batch.features(), torch.addmm(self.base, c, self.basis), self.shapes)
        return relative_loss(torch.exp(log_factor.clamp(-LOG_RANGE, LOG_RANGE)), batch)

    def parameters_as_arrays(self) -> dict[str, np.ndarray]:
        """Arrays for the file of weights, in half precision."""
        layers = {}
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            layers |= {f"medium_{k}_W": W, f"medium_{k}_b": b}
        arrays = {**layers, "base": self.base, "basis": self.basis}
        return {name: value.detach().numpy().astype(np.float16) for name, value in arrays.items()}


LEAST_ABSORPTION = 1e-5  # 1 - albedo of the log-uniform half


def draw_media(
    n: int, rng: np.random.Generator, steep_share: float = 1 / 3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """albedo, g and eta of n media.

    albedo: half uniform, half log-uniform in 1 - albedo down to 1e-5, one in fifty exactly 1. g: uniform, but for
    `steep_share` log-uniform in 1 - g below 0.5. eta: uniform, one in ten exactly 1.
    """
    u = rng.random((6, n))
    (a_0, a_1), (g_0, g_1), (e_0, e_1) = RANGES["albedo"], RANGES["g"], RANGES["eta"]
    albedo = np.where(u[0] < 0.5, a_0 + (a_1 - a_0) * u[1], 1 - LEAST_ABSORPTION ** u[1])
    albedo = np.where(u[0] > 0.98, 1.0, albedo)
    g = np.where(u[2] < 1 - steep_share, g_0 + (g_1 - g_0) * u[3], 1 - 0.5 * ((1 - g_1) / 0.5) ** u[3])
    eta = np.where(u[4] < 0.1, 1.0, e_0 + (e_1 - e_0) * u[5])
    return albedo, g, eta


def calibration_terms(mu: np.ndarray, mu_in: np.ndarray) -> np.ndarray:
    """What `log_calibration` has for each coefficient, the last axis."""
    polynomials = np.polynomial.chebyshev.chebvander(2 * np.asarray(mu) - 1, N_POLYNOMIALS - 1)
    return np.concatenate([polynomials, *((s / (s + mu_in))[..., None] for s in GRAZING)], axis=-1)


class Fluxes(NamedTuple):
    """For n media: albedo, g, eta (n, 3); cosines of incidence (n, COSINES); of each the exact R of all orders and of
    the single one, and the flux of the network towards each interval (n, COSINES, INTERVALS) with its error over R."""

    ratios: np.ndarray
    mu_i: np.ndarray
    exact: np.ndarray
    single: np.ndarray
    flux: np.ndarray
    error: np.ndarray


def collect(
    hyper: Hypernetwork, n: int, seed: int, folder: Path | None = None, progress: NamedProgress | None = None
) -> Fluxes:
    """What the fit needs of n media, kept in `folder` as it comes; progress: ("reflectances", media done, media)."""
    rng = np.random.default_rng([seed, 2])
    ratios = _media(n, rng)
    mu_i = ((np.arange(COSINES) + rng.random((n, COSINES))) / COSINES) ** STEEPNESS
    mu_i[:, -1] = np.where(rng.random(n) < 0.5, 1.0, mu_i[:, -1])  # normal incidence is asked for most
    results = []
    for at in range(0, n, CHUNK):
        media = range(at, min(at + CHUNK, n))
        place = folder / f"reflectances-{at // CHUNK:05d}.npy" if folder else None
        if place and place.exists():
            rows = load_maps(place, (len(media), COSINES, 3 + INTERVALS))
        else:
            rows = np.stack([_row(hyper, ratios[k], mu_i[k], (seed, 3, k)) for k in media])  # no scramble is shared
            rows = rows.astype(np.float32)
            if place:
                file = io.BytesIO()
                np.save(file, rows)
                write_atomically(place, file.getvalue())
        results.append(rows)
        if progress:
            progress("reflectances", min(at + CHUNK, n), n)
    exact, single, error, flux = np.split(np.concatenate(results).astype(np.float64), [1, 2, 3], axis=2)
    return Fluxes(ratios, mu_i, exact[..., 0], single[..., 0], flux, error[..., 0])


def _media(n: int, rng: np.random.Generator) -> np.ndarray:
    """albedo, g and eta of media (n, 3): of the whole range, and more of those that the network is weakest for."""
    albedo, g, eta = draw_media(n, rng)
    u = rng.random((5, n))
    steep = u[0] < STEEP
    albedo = np.where(u[1] < 0.15, 1.0, np.maximum(albedo, LEAST_ALBEDO))
    g = np.where(steep, np.minimum(1 - 0.018 * 7 ** u[2], RANGES["g"][1]), g)
    nearly = np.where(u[3] < 0.8, 1 + 1e-3 * 100 ** u[4], eta)
    return np.stack([albedo, g, np.where(u[3] < 0.45, 1.0, np.where(steep, nearly, eta))], axis=1)


def _row(hyper: Hypernetwork, ratios: np.ndarray, mu_i: np.ndarray, seed: tuple[int, ...]) -> np.ndarray:
    """Exact R of all orders and of the single one, relative error and fluxes of a medium, (COSINES, 3 + INTERVALS)."""
    medium = Medium.from_albedo(ratios[0], 1.0, ratios[1], ratios[2])
    model = Trial(medium, hyper.network(*ratios.tolist()))
    exact = np.array([medium.reflectance(float(mu)) for mu in mu_i])
    single = np.minimum(single_scattering.reflectance(medium, mu_i), exact)
    flux, spread = _fluxes(model, mu_i, POINTS, seed)
    if (spread > NOISY * exact).any():
        flux, spread = _fluxes(model, mu_i, MORE * POINTS, seed)
    return np.concatenate([np.stack([exact, single, spread / exact], axis=1), flux], axis=1)


def _fluxes(model: Trial, mu_i: np.ndarray, points: int, seed: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Flux towards each interval and the standard error of their sum, for each cosine of incidence."""
    result = exits(model, np.repeat(mu_i, REPEATS).tolist(), points, seed)
    interval = np.minimum((result.mu_o ** (1 / STEEPNESS) * INTERVALS).astype(int), INTERVALS - 1)
    flux = np.stack([np.bincount(b, f, INTERVALS) for b, f in zip(interval, result.flux)])
    flux = flux.reshape(len(mu_i), REPEATS, INTERVALS)
    return flux.mean(axis=1), flux.sum(axis=2).std(axis=1, ddof=1) / np.sqrt(REPEATS)


class _Balance(nn.Module):
    """Coefficients of log a from the features of a medium."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        sizes = [N_MEDIUM, *[WIDTH] * HIDDEN, N_TERMS]
        gains = [1.0] * HIDDEN + [0.05]
        self.matrices = nn.ParameterList(
            gain * torch.randn(i, j, generator=generator) / i**0.5 for gain, i, j in zip(gains, sizes, sizes[1:])
        )
        self.biases = nn.ParameterList(torch.zeros(j) for j in sizes[1:])

    def forward(self, h: torch.Tensor) -> torch.Tensor:
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            h = torch.addmm(b, h, W)
            if k < HIDDEN:
                h = nn.functional.silu(h)
        return h

    def residual(self, batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """log of the network's R with a over the exact one, (media, COSINES)."""
        features, T_i, T_o, exact, single, flux, _ = batch
        c = self(features)
        a_o = torch.exp(torch.einsum("nbk,nk->nb", T_o, c))
        R = torch.einsum("nib,nb->ni", flux, a_o) * torch.exp(torch.einsum("nik,nk->ni", T_i, c))
        return torch.log((R + single) / exact)

    def loss(self, batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
        off = self.residual(batch)
        return (batch[-1] * nn.functional.huber_loss(off, torch.zeros_like(off), "none", OUTLIER)).mean()

    def layers(self) -> Layers:
        pairs = zip(self.matrices, self.biases)
        return tuple(tuple(v.detach().numpy().astype(np.float16) for v in pair) for pair in pairs)


def _batches(data: Fluxes, size: int) -> Callable[[torch.Generator], tuple[torch.Tensor, ...]]:
    """Random media of the data as arguments of `_Balance.residual`."""
    albedo, g, eta = (torch.from_numpy(v.copy()) for v in data.ratios.T)
    lib, L = torch_library(), length_scale(albedo, g)
    features = torch.stack(medium_features(lib, albedo, g, eta, L), -1)
    usable = np.isfinite(data.error) & (data.flux.sum(axis=2) > 0)
    weight = np.where(usable, TRUSTED**2 / (TRUSTED**2 + np.where(usable, data.error, 1.0) ** 2), 0.0)
    flux = np.where(usable[..., None], data.flux, data.exact[..., None] / INTERVALS)
    aim = data.exact * (1 - BELOW * np.clip((data.exact - 1) / BRIGHT + 1, 0, 1) ** 2)
    middles = np.broadcast_to(((np.arange(INTERVALS) + 0.5) / INTERVALS) ** STEEPNESS, (len(data.mu_i), INTERVALS))
    T_i, T_o = (calibration_terms(mu, mu_internal(mu, data.ratios[:, 2:])) for mu in (data.mu_i, middles))
    features, *arrays = (torch.from_numpy(np.asarray(v)).float()
                         for v in (features, T_i, T_o, aim, data.single, flux, weight))  # fmt: skip

    def batch(generator: torch.Generator) -> tuple[torch.Tensor, ...]:
        n = torch.randint(len(features), (size,), generator=generator)
        return features[n], *(v[n] for v in arrays)

    return batch


def calibrated(data: Fluxes, how: Fit, seed: int) -> Layers:
    """The layers that give the coefficients of log a of a medium, fitted to `data`; `n_groups` media a step."""
    learner = _Balance(seed)
    fit(learner, _batches(data, how.n_groups), how, seed)
    return learner.layers()


def looking_back(groups: Groups, rng: np.random.Generator) -> Groups:
    """The same groups with two directions of observation near that from which the light comes.

    There the refracted rays lie close to each other and the features of a pair change fastest, and there are all curves
    of normal incidence and exit; uniform directions hardly ever fall there. The distance from w_i is 0.001 to 0.3.
    """
    n = (len(groups), N_BACK)
    off = rng.standard_normal((3, *n))
    off *= 10 ** rng.uniform(*BACK, n) / np.linalg.norm(off, axis=0)
    mu_i = groups.mu_i[:, None]
    x, y, z = off[0] - np.sqrt(1 - mu_i**2), off[1], off[2] + mu_i
    lowest = np.sqrt(np.maximum(1 - groups.eta**2, 0.0))[:, None]
    mu_o, delta_phi = groups.mu_o.copy(), groups.delta_phi.copy()
    mu_o[:, -N_BACK:] = np.clip(np.abs(z) / np.sqrt(x * x + y * y + z * z), lowest, 1.0)
    delta_phi[:, -N_BACK:] = np.arctan2(y, x)
    return replace(groups, mu_o=mu_o, delta_phi=delta_phi)


def named_layers(name: str, layers: Layers) -> dict[str, np.ndarray]:
    """Matrices and biases by name, for the file of weights."""
    return {f"{name}_{k}_{n}": v for k, pair in enumerate(layers) for n, v in zip("Wb", pair)}


@dataclass(frozen=True)
class UniversalRecipe:
    """Size of the training.

    Args:
        n_media: of the maps, each with one direction of incidence and 16 of observation.
        events: scattering events of the maps.
        grid: cells of a map.
        how: the fit.
        rank: numbers that describe a medium.
        calibration_media: whose reflectances the factor `calibration` is fitted to.
        calibration_how: that fit, of `n_groups` media a step.
    """

    n_media: int = 16384
    events: float = 1e10
    grid: CellGrid = CellGrid(40, 16)
    how: Fit = field(default_factory=lambda: Fit(steps=150_000, n_groups=32, n_queries=128))
    rank: int = 48
    calibration_media: int = 4096
    calibration_how: Fit = field(default_factory=lambda: Fit(steps=25_000, n_groups=256))

    def __post_init__(self) -> None:
        check_count("n_media", self.n_media, 1)
        check_count("calibration_media", self.calibration_media, 1)
        check_count("rank", self.rank, 1)
        check_interval("events", self.events, 1e4, 1e15)


def train_universal(
    folder: str | os.PathLike[str],
    seed: int = 0,
    recipe: UniversalRecipe | None = None,
    *,
    backend: str = "llvm",
    progress: NamedProgress | None = None,
    validate: Callable[[Hyper], float] | None = None,
) -> Path:
    """Train the universal network in `folder`, going on with what a killed run left there; returns the weights.

    Args:
        folder: gets maps, checkpoint and `neural.safetensors` with its record.
        seed: media, maps, batches and first weights follow from it.
        recipe: size of the training.
        backend: of the maps, "llvm" or "cuda".
        progress: called with (what, done, total).
        validate: error of the learner, for the history.

    Raises:
        ValueError: an argument is out of range, or the folder holds the work of another run; nothing was done then.
    """
    recipe, folder, started = recipe or UniversalRecipe(), Path(folder), time.monotonic()
    check_count("seed", seed, 0)
    array_types(backend)
    seed = int(seed)  # torch takes no other
    claim(check_folder(folder), recipe=asdict(recipe), seed=seed, backend=backend)
    rng = np.random.default_rng([seed, 0])
    groups = looking_back(draw_directions(*draw_media(recipe.n_media, rng), rng), rng)
    halves = make_pool(groups, recipe.grid, recipe.events, (seed, 1), folder, progress, backend)
    pool, data_seconds = MapPool(groups, recipe.grid, halves), time.monotonic() - started
    del halves
    learner = Hyper(rank=recipe.rank, seed=seed)
    how, check = recipe.how, (lambda: validate(learner)) if validate else None
    history, _ = fit(learner, pool.batches(how.n_groups, how.n_queries), how, seed, checkpoint=folder / CHECKPOINT,
                     validate=check, progress=progress)  # fmt: skip
    arrays = learner.parameters_as_arrays()
    hyper = hypernetwork_of(arrays, learner.width, learner.depth)
    known = collect(hyper, recipe.calibration_media, seed, folder, progress)
    arrays |= named_layers(CALIBRATION, calibrated(known, recipe.calibration_how, seed))
    record: JsonDict = {
        "width": learner.width, "depth": learner.depth, "ranges": {k: list(v) for k, v in RANGES.items()}, "seed": seed,
        "recipe": asdict(recipe), "data_seconds": data_seconds, "seconds": time.monotonic() - started,
        "history": history, "provenance": provenance(seed=seed),
    }  # fmt: skip
    return save_weights(folder / "neural.safetensors", "neural", arrays, record)
