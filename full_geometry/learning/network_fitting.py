"""Fitting the networks of one object by likelihood; functions of single ends are solved for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import torch
from torch import nn

from full_geometry.transport.exit_pairs import ENOUGH, Pairs, PairSource
from full_geometry.transport.features import Terms, entering, n_pair, reverse
from full_geometry.transport.one_object import BOUND
from full_geometry.transport.patches import Patches
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.training.fit import Descent, cosine, gone_on_with, torch_threads, warm_up, write_checkpoint

LEAST_SHARE = 1e-5  # of F_t P that comes back


class DenseLayers(nn.Module):
    """A perceptron with hard swish between its layers; 0 initially."""

    def __init__(self, sizes: list[int], generator: torch.Generator) -> None:
        super().__init__()
        self.matrices, self.biases = nn.ParameterList(), nn.ParameterList()
        last = len(sizes) - 2
        for k, (i, j) in enumerate(zip(sizes, sizes[1:])):
            gain = math.sqrt((1.0 if k == 0 else 2.0) / i) if k < last else 0.0
            self.matrices.append(gain * torch.randn(j, i, generator=generator))
            self.biases.append(torch.zeros(j, 1))

    def forward(self, x: torch.Tensor, first: torch.Tensor | None = None) -> torch.Tensor:
        """The outputs for columns x; `first` takes the place of the first matrix."""
        return torch.addmm(self.biases[-1], self.matrices[-1], self.units(x, first))

    def units(self, x: torch.Tensor, first: torch.Tensor | None = None) -> torch.Tensor:
        """The inputs of the last layer."""
        matrices = list(self.matrices) if first is None else [first, *self.matrices[1:]]
        for W, b in list(zip(matrices, self.biases))[:-1]:
            x = nn.functional.hardswish(torch.addmm(b, W, x))
        return x

    def take(self, arrays: Mapping[str, np.ndarray], matrix: str, bias: str) -> None:
        """The numbers that `arrays` gave."""
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            W.copy_(torch.from_numpy(arrays[f"{matrix}_{k}"].astype(np.float32)))
            b.copy_(torch.from_numpy(arrays[f"{bias}_{k}"].astype(np.float32))[:, None])

    def arrays(self, matrix: str, bias: str) -> dict[str, np.ndarray]:
        arrays: dict[str, np.ndarray] = {}
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            W, b = (v.detach().cpu().numpy().copy() for v in (W, b))
            arrays |= {f"{matrix}_{k}": W, f"{bias}_{k}": b[:, 0].copy()}
        return arrays


class NamedNetwork(nn.Module):
    """A network of dense layers, whose matrices (outputs, inputs) and biases have names in files."""

    NAMES: tuple[str, str]
    layers: DenseLayers

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices and biases by name."""
        return self.layers.arrays(*self.NAMES)

    def take(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the numbers that `arrays` gave."""
        self.layers.take(arrays, *self.NAMES)


class Correction(NamedNetwork):
    """f = 6 tanh(g/6) per channel, g a perceptron; 0 initially.
    `n_in`: features. `channels`: outputs."""

    NAMES = ("W", "b")

    def __init__(self, n_in: int, channels: int, width: int = 64, depth: int = 3, seed: int = 0) -> None:
        super().__init__()
        self.layers = DenseLayers([n_in, *[width] * depth, channels], torch.Generator().manual_seed(seed))
        order, signs = reverse((n_in - n_pair(channels)) // 2, channels)
        back = np.argsort(order)
        self.register_buffer("order", torch.from_numpy(back), persistent=False)
        self.register_buffer("signs", torch.from_numpy(signs[back]), persistent=False)

    def forward(self, x: torch.Tensor, back: bool = False) -> torch.Tensor:
        """f (channels, n) of features (inputs, n); `back` reads pairs the other way round, exit and entry exchanged."""
        first = self.layers.matrices[0][:, self.order] * self.signs if back else None
        return BOUND * torch.tanh(self.layers(x, first) / BOUND)


def likelihood(walks: tuple[torch.Tensor, ...], proposals: tuple[torch.Tensor, ...], kept: float) -> torch.Tensor:
    """E_q[(S_0 mu_i / q) exp f] - E_walks[T f], sum over channels.
    `walks`: f and T, (channels, n) both. `proposals`: f and S_0 mu_i / q, (channels, m) both. `kept`: share of all
    walks that the n stand for."""
    (f, T), (g, W) = walks, proposals
    return ((W * torch.exp(g)).mean(dim=1) - kept * (T * f).mean(dim=1)).sum()


class AlbedoNetwork(NamedNetwork):
    """F_t P sigmoid(a) of orders one, then two and more, per channel, a a perceptron of the exit.
    `n_in`: features of an exit. `hidden`: widths of the hidden layers. `eta`: relative index."""

    NAMES = ("A", "a")

    def __init__(self, n_in: int, channels: int, hidden: tuple[int, ...], eta: float, seed: int = 0) -> None:
        super().__init__()
        self.eta, self.channels = eta, channels
        self.layers = DenseLayers([n_in, *hidden, 2 * channels], torch.Generator().manual_seed(seed))

    def _most(self, x: torch.Tensor) -> torch.Tensor:
        return torch.stack(entering(x, self.eta, self.channels)[1] * 2)

    def begin(self, x: torch.Tensor, mean: torch.Tensor) -> None:
        """Begin with a share of F_t P that is the same everywhere, and gives the mean over exits x."""
        share = (mean / self._most(x).mean(dim=1).clamp_min(1e-6)).clamp(LEAST_SHARE, 1 - LEAST_SHARE)
        with torch.no_grad():
            self.layers.biases[-1].copy_(torch.logit(share)[:, None])

    def shift(self, x: torch.Tensor, T: torch.Tensor) -> None:
        """Have the mean over exits x come to that of T, (2 channels, n), by the last bias."""
        with torch.no_grad():
            most, a = self._most(x), self.layers(x)
            for _ in range(4):  # Newton
                p = torch.sigmoid(a)
                step = (T.mean(dim=1) - (most * p).mean(dim=1)) / (most * p * (1 - p)).mean(dim=1).clamp_min(1e-9)
                step = step.clamp(-2, 2)[:, None]
                a = a + step
                self.layers.biases[-1].add_(step)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Shares (2 channels, n) of features (inputs, n), and their logarithms up to that of F_t P."""
        a = self.layers(x)
        return self._most(x) * torch.sigmoid(a), nn.functional.logsigmoid(a)

    def joined(self, x: torch.Tensor) -> torch.Tensor:
        """Features of pairs, with the units before the last layer behind those of exit and entry."""
        n, lanes = self.layers.matrices[0].shape[1], x.shape[1]
        exit, entry, pair = x.split([n, n, len(x) - 2 * n])
        units = self.layers.units(torch.cat([exit, entry], dim=1)).split(lanes, dim=1)
        return torch.cat([exit, units[0], entry, units[1], pair])


def mean_likelihood(both: tuple[torch.Tensor, ...], T: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """E[alpha - T log alpha] over walks, sum over channels times their scale; its minimum is alpha = E[T | exit].
    `both`: from `AlbedoNetwork`. `T`: (2 channels, n). `scale`: (2 channels, 1)."""
    alpha, log_alpha = both
    return (scale * (alpha - T * log_alpha)).mean(dim=1).sum()


class PatchLogits(NamedNetwork):
    """log p(patch | exit) up to a constant; initially the shares of the area, which its arrays are without.
    `n_in`: features of an exit. `areas`: of the patches. `hidden`: widths of the hidden layers."""

    NAMES = ("V", "c")

    def __init__(self, n_in: int, areas: np.ndarray, hidden: tuple[int, ...], seed: int = 0) -> None:
        super().__init__()
        self.layers = DenseLayers([n_in, *hidden, len(areas)], torch.Generator().manual_seed(seed))
        shares = np.log(np.maximum(areas / areas.sum(), 1e-30))
        self.register_buffer("log_share", torch.from_numpy(shares.astype(np.float32))[:, None])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x) + self.log_share


def patch_likelihood(logits: torch.Tensor, T: torch.Tensor, patch: torch.Tensor) -> torch.Tensor:
    """-E[T log p(patch of x_i | exit)] over walks, for T (n,) of one channel or a mean of them."""
    return (T * nn.functional.cross_entropy(logits.T, patch, reduction="none")).mean()


LAST_RATE, WARM_UP = 0.01, 100
AVERAGE = 0.998  # of the numbers, each step
PROPOSED = 2  # proposals for a walk that is kept
SOLVED = 0.5  # chunks of proposals, of those of a training, by which functions of ends are solved for
BEYOND = 2**30  # number of the first of these chunks
BLOCK = 4096  # pairs whose layers stay in the cache
LEAST = 0.05  # chance of a proposal: f moves while the chunk is used
PATCH_HIDDEN, PATCH_BATCH = (64, 32), 1024
ALPHA_HIDDEN = (32, 16)
REFINING = 4  # parts of rate and chunk where a training starts from other weights


@dataclass(frozen=True)
class Recipe:
    """How an object is learnt.

    Args:
        width, depth: hidden layers of the network.
        batch: walks, and proposals, of a step.
        rate: largest learning rate.
        chunk: walks that are kept of those made at once, with twice as many proposals.
        reuse: times that each is used.
    """

    width: int = 48
    depth: int = 3
    batch: int = 2048
    rate: float = 6e-3
    chunk: int = 2**17
    reuse: int = 2

    def __post_init__(self) -> None:
        for name in ("width", "depth", "batch", "chunk", "reuse"):
            check_count(name, getattr(self, name), 1)
        check_interval("rate", self.rate, 1e-8, 1.0)

    def refining(self) -> Recipe:
        """The same for weights that begin near: smaller steps, and chunks of a fraction of a second."""
        return replace(self, rate=self.rate / REFINING, chunk=max(self.chunk // REFINING, self.batch))


STANDARD = Recipe()


class ObjectFit:
    """The state of a fit, which follows from recipe, seed, number of steps, data and device.
    `n_in`: features of a pair. `patches`: of the surface, for whose weights a network is fitted beside; None for a
    shape without faces."""

    def __init__(
        self, n_in: int, channels: int, eta: float, recipe: Recipe, seed: int, patches: Patches | None = None
    ) -> None:
        self.recipe, self.patches, self.n_side = recipe, patches, (n_in - n_pair(channels)) // 2
        parts = {
            "S": Correction(n_in + 2 * ALPHA_HIDDEN[-1], channels, recipe.width, recipe.depth, seed),
            "alpha": AlbedoNetwork(self.n_side, channels, ALPHA_HIDDEN, eta, seed),
        }
        if patches is not None:
            parts["patches"] = PatchLogits(self.n_side, patches.areas, PATCH_HIDDEN, seed)
        # beside the walks that are the data: the GPU if Mitsuba's variant runs there and torch can, else the CPU
        there = (mi.variant() or "").startswith("cuda") and torch.cuda.is_available()
        self.device = torch.device("cuda" if there else "cpu")
        self.ends = Ends(channels, self.n_side, self.device)
        self.modules = torch.nn.ModuleDict(parts).to(self.device)
        self.descent = Descent(self.modules, parts=list(self.modules.values()), average=AVERAGE, fused=True)
        self.average: torch.nn.ModuleDict = self.descent.average
        ones = torch.ones(2 * channels, 1, device=self.device)
        self.scale, self.alpha_scale = ones[:channels].clone(), ones

    @property
    def step(self) -> int:
        return self.descent.steps

    def set_scale(self, walks: Pairs) -> None:
        """Divide each channel by its mean throughput, so that all count alike; alpha begins with the mean.
        Order one counts as a part of all light: where it hardly leaves, its few large values would drown the rest."""
        self.scale = _inverse(self._tensor(walks.values.sum(axis=1) / walks.drawn))
        exits, T = (self._tensor(v) for v in walks.albedo)
        mean = T.mean(dim=1)
        once, more = mean.split(len(mean) // 2)
        self.alpha_scale = _inverse(torch.cat([once + more, more]))
        for networks in (self.modules, self.average):
            networks["alpha"].begin(exits, mean)

    def start(self, arrays: Mapping[str, np.ndarray], walks: Pairs) -> None:
        """Begin with weights of the same recipe; alpha keeps the mean that `set_scale` gave it.
        `arrays`: of the networks, as `arrays` names them. `walks`: of the pilot."""
        for networks in (self.modules, self.average):
            with torch.no_grad():
                for module in networks.values():
                    module.take(arrays)
            networks["alpha"].shift(*(self._tensor(v) for v in walks.albedo))

    def use(self, walks: Pairs, proposals: Pairs, steps: int | None, order: np.random.Generator) -> None:
        """Steps on all batches of a chunk, `reuse` times over, every other time with exit and entry exchanged.
        As S is reciprocal and exits are drawn by area and cosine, a pair read backwards is as good a sample. `walks`,
        `proposals`: the chunk. `steps`: of the whole fit, for the decay of the rate; None for no decay. `order`: of the
        batches, in which walks meet other proposals each time, and of the proposals that are used."""
        batch = self.recipe.batch
        x, T = (self._tensor(v) for v in (walks.features, walks.values))
        y, W = self._worthy(proposals, order)
        exits, T_alpha = (self._tensor(v) for v in walks.albedo)
        patch = None
        if self.patches is not None:
            patch = self._tensor(self.patches.of_face[walks.faces].astype(np.int64))
        n_x, n_y = max(T.shape[1] // batch, 1), max(W.shape[1] // batch, 1)
        kept, n_alpha = T.shape[1] / walks.drawn, max(T_alpha.shape[1] // n_x, 1)
        T, W = T * self.scale, W * self.scale
        with torch.no_grad(), torch_threads():
            self.ends.add_walks(*walks.of_random_exits(x, T))
        with torch_threads():
            for k in range(self.recipe.reuse):
                back = k % 2 == 1
                for i, j in zip(order.permutation(n_x), order.integers(0, n_y, n_x)):
                    a, b, e = (slice(k * m, (k + 1) * m) for k, m in ((i, batch), (j, batch), (i, n_alpha)))
                    loss = likelihood((self._f(x[:, a], back), T[:, a]), (self._f(y[:, b], back), W[:, b]), kept)
                    loss = loss + mean_likelihood(self.modules["alpha"](exits[:, e]), T_alpha[:, e], self.alpha_scale)
                    if patch is not None and not back:
                        some = slice(i * batch, i * batch + min(batch, PATCH_BATCH))
                        logits = self.modules["patches"](x[: self.n_side, some])
                        loss = loss + patch_likelihood(logits, T[:, some].mean(dim=0), patch[some])
                    self._advance(loss, steps)

    def solve(self, source: PairSource, chunks: int, seed: int) -> None:
        """Find what the averaged fit lacks of exits and entries, see `Ends`, by proposals that it has not seen.
        `source`: of the proposals. `chunks`: of the training; half as many are made."""
        for k in range(max(round(SOLVED * chunks), 1)):
            made = source.proposed(PROPOSED * self.recipe.chunk, (seed, BEYOND + k))
            with torch.no_grad(), torch_threads():
                y, _, V = self._light(made, self.average)
                self.ends.add_proposals(y, V)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        """An array where networks are fitted; on the CPU without a copy."""
        return torch.from_numpy(array).to(self.device)

    def _f(self, x: torch.Tensor, back: bool = False, of: torch.nn.ModuleDict | None = None) -> torch.Tensor:
        """f of the features x of pairs: S knows the directional albedos of both ends."""
        of = of or self.modules
        return of["S"](of["alpha"].joined(x), back)

    def _light(self, proposals: Pairs, of: torch.nn.ModuleDict) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Features and values W of proposals, and their light W exp f by some networks, scaled."""
        y, W = self._tensor(proposals.features), self._tensor(proposals.values)
        f = [self._f(part, of=of) for part in y.split(BLOCK, dim=1)]
        return y, W, W * self.scale * torch.exp(torch.cat(f, dim=1))

    def _worthy(self, proposals: Pairs, order: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Features and values of some proposals, kept by chance as walks are: by W exp f as the fit has it now."""
        with torch.no_grad(), torch_threads():
            y, W, V = self._light(proposals, self.modules)
            value = V.mean(dim=0)
            p = (value / (ENOUGH * value.mean().clamp_min(1e-30))).clamp(LEAST, 1.0)
            kept = torch.nonzero(self._tensor(order.random(len(p), np.float32)) < p)[:, 0]
            return y[:, kept], W[:, kept] * (len(kept) / len(p)) / p[kept]

    def arrays(self) -> dict[str, np.ndarray]:
        """The averaged numbers of all networks by name, and what is solved for beside them."""
        arrays = {name: value for module in self.average.values() for name, value in module.arrays().items()}
        return {**arrays, "Q": self.ends.solved()}

    def _advance(self, loss: torch.Tensor, steps: int | None) -> None:
        at = min(self.step / max(steps, 1), 1.0) if steps is not None else 0.0
        self.descent.step(loss, cosine(self.recipe.rate * warm_up(self.step, WARM_UP), at, LAST_RATE))

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything the next step depends on, by name; changing the tensors in place changes the fit."""
        scales = {"scale": self.scale, "alpha_scale": self.alpha_scale, **self.ends.tensors()}
        return {**scales, **self.descent.tensors()}

    def save(self, path: Path, done: int, history: list) -> None:
        """Write a checkpoint after `done` chunks."""
        rows = torch.tensor([list(row) for row in history], dtype=torch.float64).reshape(-1, 3)
        counters = torch.tensor([self.step, done], dtype=torch.float64)
        write_checkpoint(path, self._tensors(), counters=counters, history=rows)

    def load(self, path: Path) -> tuple[int, list]:
        """Go on from a checkpoint; returns its chunks and history.
        ValueError if it is damaged or of another recipe."""
        with gone_on_with(path, self._tensors()) as stored:
            self.descent.steps, done = (int(v) for v in stored["counters"].tolist())
            history = [(int(k), error, spread) for k, error, spread in stored["history"].tolist()]
        return done, history


def _inverse(mean: torch.Tensor) -> torch.Tensor:
    """1/mean as a column, 0 where there is nothing."""
    return torch.where(mean > 0, 1 / mean.clamp_min(1e-30), torch.zeros_like(mean))[:, None].float()


# ----------------------------------------------------------------------------------------------------
# What steps leave of the ends of pairs, solved for at the end: quadratic functions of exit and of entry.
# Along some directions, such as what surrounds an end, the loss of single pairs is so flat and noisy that steps do not
# get there. With phi the `Terms` of an end, of a pair the sum of both, f becomes f + c . phi by a Newton step
#
#     c = (H + r)^-1 (E[T phi] - E[V phi]),    H = E[V phi phi^T],
#
# T of walks, V the light of proposals as the fit has it, after which both agree in every one of the terms. T does not
# know the fit, so that E[T phi] is over all walks that it has seen. r keeps small what these do not tell.

RIDGE = 1e6  # times 1/n of walks and of proposals, effective numbers, is r over the diagonal of H
SMALLEST = 1e-8  # of the diagonal of H; terms below tell nothing, and would get coefficients beyond all bounds
SAMPLE = 2**14  # pairs that H is taken over
COLUMNS = 8192  # columns at once


class Ends:
    """Sums over walks and proposals of some channels.
    `n`: features of a side."""

    def __init__(self, channels: int, n: int, device: torch.device) -> None:
        self.n = n
        self.heads, self.rows, self.cols = (torch.from_numpy(v).to(device) for v in Terms.of(n))
        p = len(self.rows)
        self.walked, self.lit = (torch.zeros(channels, p, device=device) for _ in range(2))
        # sums of T and V, and of their squares; numbers
        self.of_T, self.of_V = (torch.zeros(2, channels, device=device) for _ in range(2))
        self.drawn, self.proposed = torch.zeros(1, device=device), 0
        self.curve = torch.eye(p, device=device).repeat(channels, 1, 1)  # H

    def tensors(self) -> dict[str, torch.Tensor]:
        """The arrays of walks, by name."""
        return {f"ends.{name}": getattr(self, name) for name in ("walked", "of_T", "drawn")}

    def add_walks(self, x: torch.Tensor, T: torch.Tensor, drawn: int) -> None:
        """Walks of random exits, of so many that were drawn: features (inputs, columns), T (channels, columns)."""
        self.of_T += _moments(T)
        self.drawn += drawn
        self.walked += self._sums(x, T)

    def add_proposals(self, x: torch.Tensor, V: torch.Tensor) -> None:
        """Proposals for random exits, V (channels, columns) with the light as its mean."""
        if self.proposed == 0:
            self._curve(x[:, :SAMPLE], V[:, :SAMPLE])
        self.of_V += _moments(V)
        self.proposed += V.shape[1]
        self.lit += self._sums(x, V)

    def solved(self) -> np.ndarray:
        """c, (channels, products); 0 without proposals."""
        lit, walked = self.lit.double() / max(self.proposed, 1), self.walked.double() / self.drawn.clamp_min(1.0)
        noise = sum(squares / total.clamp_min(1e-30) ** 2 for total, squares in (self.of_T, self.of_V))
        c = torch.zeros_like(lit)
        for k in torch.nonzero((self.of_V[0] > 0) & (self.of_T[0] > 0))[:, 0].tolist():
            H = self.curve[k].double()
            scale = H.diagonal().clamp_min(SMALLEST).rsqrt()
            H = H * scale[:, None] * scale
            H += torch.diag(H.new_full((len(H),), RIDGE * float(noise[k])))
            light = self.of_V[0, k] / self.proposed
            c[k] = scale * torch.linalg.solve(H, scale * (walked[k] - lit[k]) / light)
        return c.float().cpu().numpy()

    def _sides(self, x: torch.Tensor) -> list[torch.Tensor]:
        """(1, features) of both ends."""
        one = torch.ones(1, x.shape[1], device=x.device)
        return [torch.cat([one, x[k * self.n : (k + 1) * self.n]]) for k in range(2)]

    def _sums(self, x: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        """Sums over columns of value times the terms of both ends, (channels, products)."""
        sums = torch.zeros(len(value), len(self.heads), self.n + 1, device=x.device)
        for part, v in zip(x.split(COLUMNS, dim=1), value.split(COLUMNS, dim=1)):
            for s in self._sides(part):
                for k, w in enumerate(v):
                    sums[k].addmm_(s[self.heads] * w, s.T)
        return sums[:, self.rows, self.cols]

    def _curve(self, x: torch.Tensor, V: torch.Tensor) -> None:
        """H of each channel."""
        phi = sum(s[self.heads][self.rows] * s[self.cols] for s in self._sides(x))
        for H, value in zip(self.curve, V):
            H.copy_((phi * value) @ phi.T / value.sum().clamp_min(1e-30))


def _moments(value: torch.Tensor) -> torch.Tensor:
    """Sums of rows and of their squares."""
    return torch.stack([value.sum(dim=1), (value * value).sum(dim=1)])
