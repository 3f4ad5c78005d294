"""What each choice of `neural_material` brings, against the paper's setting at equal data and equal training time."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import nn

from benchmarks.budgets import Budget, Samples, Seconds, Within
from halfspace_sss.arrays import Real, library
from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_count
from halfspace_sss.comparison.model_errors import ReferenceSize, TracedMaps, model_error, reference_maps
from halfspace_sss.executors import completed
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.maps.noisy_maps import draw_directions, make_pool, radial_edges
from halfspace_sss.neural.network import N_FEATURES, RELU, SILU, Network, layer_shapes
from halfspace_sss.neural.paper_model import N_INPUTS, T_SMALLEST, NeuralPaper, query_inputs
from halfspace_sss.neural.training.fit import fit
from halfspace_sss.neural.training.learners import (
    Batch,
    MapPool,
    PaperLearner,
    apply_networks,
    initial_numbers,
    relative_loss,
)
from halfspace_sss.neural.training.train_material import (
    BLOCK,
    STANDARD,
    VALIDATION_SEED,
    MaterialRecipe,
    MaterialTraining,
    PaperTraining,
    Trial,
)
from halfspace_sss.neural.universal import in_range
from halfspace_sss.physics.backbone import backbone, length_scale, unwarp
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium, check_scalar_medium
from halfspace_sss.progress import NamedProgress

if TYPE_CHECKING:
    import pandas

LOG_RANGE = 40.0  # of log(G/B); its exponential squared is still a float32
DEPTH = 3
WIDEST_IN_DRJIT = 64  # a network 256 wide runs three times as fast in NumPy


class SharedTurn(PaperLearner):
    """The paper's network, which sees both points of a cell under one random azimuth of incidence.

    With an azimuth for each point the loss fits no more than the mean over azimuths, see `learners.cell_loss`.
    """

    def inputs(self, batch: Batch) -> torch.Tensor:
        vectors = torch.view_as_complex(super().inputs(batch).unflatten(-1, (3, 2)))  # position, w_i, w_o
        heading = torch.sgn(vectors[..., 1:2])
        first = heading[:, : batch.y.shape[1]]
        turn = torch.cat((first, first), dim=1) * heading.conj()
        return torch.view_as_real(vectors * turn).flatten(-2)


class Factored(nn.Module):
    """log(S/scale) or log(G/B) of one medium by a perceptron, fitted by the relative error.

    Args:
        paper: gives the six inputs and the scale.
        symmetric: symmetric features instead of the six inputs; with them the backbone is always there.
        with_backbone: log(G/B) rather than log(S/scale).
        silu: SiLU rather than ReLU.
        width: hidden units of each of three layers.
        seed: of the numbers at the start.
    """

    def __init__(
        self, paper: PaperLearner, symmetric: bool, with_backbone: bool, silu: bool, width: int, seed: int
    ) -> None:  # fmt: skip
        super().__init__()
        self.frame = (paper,)  # in a tuple, which hides its numbers from the optimiser
        self.symmetric, self.with_backbone = symmetric, with_backbone
        self.activation = SILU if silu else RELU
        self.shapes = layer_shapes(N_FEATURES if symmetric else N_INPUTS, width, DEPTH)
        self.numbers = nn.Parameter(initial_numbers(self.shapes, torch.Generator().manual_seed(seed)))

    def loss(self, batch: Batch) -> torch.Tensor:
        x = batch.features() if self.symmetric else self.frame[0].inputs(batch)
        log_p = apply_networks(x.flatten(0, 1)[None], self.numbers[None], self.shapes, self.activation.torch)
        log_p = log_p.view_as(batch.u)
        if not self.with_backbone:
            log_p = log_p - torch.log(self.frame[0].S_over_y(batch).clamp_min(1e-30))
        return relative_loss(torch.exp(log_p.clamp(-LOG_RANGE, LOG_RANGE)), batch)

    def network(self) -> Network:
        return Network.from_vector(self.numbers.detach().numpy(), self.shapes, self.activation)


class PlainTrial(BSSRDF):
    """The exponential of a perceptron of the paper's six inputs as a model.

    Args:
        network: log(S/scale), or log(G/B) if scale is None.
    """

    name = "plain_trial"
    orders = "multiple"
    reciprocal = False
    mirror_invariant = False
    fast_in = "numpy"
    source = "under training"

    def __init__(self, medium: Medium, network: Network, scale: float | None) -> None:
        super().__init__(medium)
        self.network, self.scale = network, scale

    def G(self, q: Query) -> Real:
        lib, m = q.lib, self.medium
        log_factor = self.network(query_inputs(q, length_scale(m.albedo, m.g)))
        factor = lib.exp(lib.minimum(lib.maximum(log_factor, -LOG_RANGE), LOG_RANGE))
        if self.scale is None:
            return backbone(q.r, m.albedo, m.g, m.eta) * factor
        return self.scale * factor / lib.maximum(F_t(q.mu_i, m.eta) * F_t(q.mu_o, m.eta), T_SMALLEST)


def model_of(learner: torch.nn.Module, medium: Medium) -> BSSRDF:
    """A learner of this table as it is, as a model of its medium."""
    network = learner.network()
    if isinstance(learner, PaperLearner):
        return NeuralPaper(medium, [(network, learner.scale)])
    if not isinstance(learner, Factored) or learner.symmetric:
        model = Trial(medium, network)
        model.fast_in = "numpy" if network.matrices[0].shape[1] > WIDEST_IN_DRJIT else "drjit"
        return model
    return PlainTrial(medium, network, None if learner.with_backbone else learner.frame[0].scale)


def drawn_by_area(pool: MapPool) -> MapPool:
    """The same maps, of which batches show cells in proportion to their area."""
    r = pool.groups.L[:, None] * unwarp(library(0.0), radial_edges(pool.groups, pool.grid))
    drawn = copy.copy(pool)
    drawn.cdf = torch.from_numpy(((r**2 - r[:, :1] ** 2)[:, 1:] / (r[:, -1:] ** 2 - r[:, :1] ** 2)).astype(np.float32))
    return drawn


SETS = 2  # of 8 directions to compare with: the wide networks take longer to be asked than to be trained
BUDGETS = (Seconds(20.0), Samples(1_000_000))


@dataclass(frozen=True)
class Variant:
    """A row of the table.

    Args:
        name: what is changed against the row above.
        learned: "S", its squared error; "log S" or "log S/B" with the analytic backbone B, their relative error.
        symmetric: symmetric features, or the six inputs of the paper.
        silu: smooth hidden units, or ReLU.
        width: hidden units of each of the three layers.
        warm: started from what the universal network says of the medium.
        by_area: shown cells in proportion to their area, as the pixels of a map are, instead of half by energy and half
            evenly over u.
    """

    name: str
    learned: str = "log S/B"
    symmetric: bool = True
    silu: bool = True
    width: int = 32
    warm: bool = False
    by_area: bool = False

    def learner(self, medium: Medium, pool: MapPool, seed: int) -> torch.nn.Module:
        """A torch module with `loss` and `network`."""
        paper = SharedTurn(medium, PaperTraining().learner(medium, pool, seed).scale, seed=seed)
        if self.learned == "S":
            return paper
        if self.symmetric and self.silu and self.width == 32:
            return MaterialTraining(self.warm).learner(medium, pool, seed)
        return Factored(paper, self.symmetric, self.learned == "log S/B", self.silu, self.width, seed)


_WIDE = {"width": 256, "silu": False}
_PAPER = {"learned": "S", "symmetric": False, **_WIDE}
VARIANTS = (
    Variant("paper: 6 inputs, S, squared error by area, 3 x 256 ReLU", by_area=True, **_PAPER),
    Variant("+ cells by energy and evenly over u", **_PAPER),
    Variant("+ exponential output, relative error", "log S", symmetric=False, **_WIDE),
    Variant("+ analytic backbone", symmetric=False, **_WIDE),
    Variant("+ symmetric features", **_WIDE),
    Variant("+ SiLU", width=256),
    Variant("+ small network, 3 x 32: neural_material"),
    Variant("+ start from the universal network", warm=True),
)


def ablation(
    medium: Medium,
    recipe: MaterialRecipe = STANDARD,
    budgets: Sequence[Budget] = BUDGETS,
    seeds: int = 3,
    seed: int = 0,
    *,
    backend: str = "llvm",
    progress: NamedProgress | None = None,
    kept: dict[str, dict[str, float]] | None = None,
    executor: Executor | None = None,
) -> pandas.DataFrame:
    """Train every variant within the same budgets on the same maps; one row per seed, budget and variant.

    Columns: budget, variant, seed, threads, kB (of the numbers in single precision), steps, samples, seconds, error,
    raw, noise, bias (fractions), and the error in each decade of r, mean free paths. Rows of a budget of samples repeat
    for the same seeds, backend, version and number of threads, but for their seconds.

    Args:
        medium: scalar; only albedo, g and eta count. Outside the range of the universal network the last variant is
            left out.
        recipe: maps, batches and largest rate; its number of steps does not count.
        budgets: each a training of every variant and seed; what the validation takes does not count.
        seeds: trainings of each variant, which differ in batches and first numbers.
        seed: of the maps; the trainings have the seeds from this one on.
        backend: of the maps, "llvm" or "cuda".
        progress: called with (what has come last, trainings done, trainings in all).
        kept: rows found before, of the same medium, recipe, seed of maps and backend; new ones are added.
        executor: where trainings run, each with the maps of its process; None: here. Equal time is the same for all
            variants only where all workers have as many threads, and cores of their own.

    Raises:
        ValueError: an argument is out of range; nothing has been traced then.
    """
    import pandas

    runs = trainings(medium, budgets, seeds, seed)
    array_types(backend)
    medium, report = medium.in_mfp(), progress or (lambda what, done, total: None)
    result = {} if kept is None else kept
    of = _Maps(float(medium.sigma_s), float(medium.sigma_a), float(medium.g), float(medium.eta), recipe, seed, backend)
    left = {name: (of, variant, budget, k) for name, (k, budget, variant) in runs.items() if name not in result}
    report("maps", len(runs) - len(left), len(runs))
    for name, row in completed(executor, _row, left):
        result[name] = row
        report(name, sum(known in result for known in runs), len(runs))
    if left:
        _data.cache_clear()
    told = {name: {"budget": str(budget), "variant": v.name, "seed": k} for name, (k, budget, v) in runs.items()}
    return pandas.DataFrame([told[name] | result[name] for name in runs])


def trainings(
    medium: Medium, budgets: Sequence[Budget], seeds: int, seed: int
) -> dict[str, tuple[int, Budget, Variant]]:
    """Seed, budget and variant of every training, by name; seeds outermost, so that other work meets all variants.

    Arguments and errors as `ablation`.
    """
    check_scalar_medium(medium)
    if not budgets or len(set(map(str, budgets))) < len(budgets):
        raise ValueError(f"budgets must be one or more different ones, got {', '.join(map(str, budgets)) or 'none'}")
    check_count("seeds", seeds, 1)
    check_count("seed", seed, 0)
    variants = [v for v in VARIANTS if not v.warm or in_range(medium.in_mfp())]
    runs = product(range(int(seed), int(seed) + seeds), budgets, variants)
    return {f"{k}, {budget}, {v.name}": (k, budget, v) for k, budget, v in runs}


def cost(runs: Iterable[tuple[int, Budget, Variant]]) -> str:
    """What trainings take, in words."""
    budgets = [budget for _, budget, _ in runs]
    seconds = sum(b.seconds for b in budgets if isinstance(b, Seconds))
    others = sum(not isinstance(b, Seconds) for b in budgets)
    parts = [f"{seconds / 60:.3g} min at equal time"] if seconds else []
    parts += [f"{others} as long as their data take"] if others else []
    return f"{len(budgets)} trainings: {', '.join(parts) or 'none left'}; maps and comparisons besides"


class _Maps(NamedTuple):
    """What maps of an ablation depend on."""

    sigma_s: float
    sigma_a: float
    g: float
    eta: float
    recipe: MaterialRecipe
    seed: int
    backend: str


@lru_cache(maxsize=1)
def _data(of: _Maps) -> tuple[MapPool, TracedMaps]:
    """Maps to learn from, as for `neural.train`, and others to compare with; once in a process."""
    medium, recipe, seed = Medium(*of[:4]), of.recipe, int(of.seed)
    n = recipe.n_groups
    ratios = (np.full(n, float(v)) for v in (medium.albedo, medium.g, medium.eta))
    groups = draw_directions(*ratios, np.random.default_rng([seed, 0]))
    halves = make_pool(groups, recipe.grid, recipe.events, (seed, 1), None, None, of.backend)
    check = (VALIDATION_SEED, seed)
    size = ReferenceSize(SETS, recipe.grid, BLOCK)
    result = reference_maps([medium], size, recipe.events / 4, check, backend=of.backend)
    return MapPool(groups, recipe.grid, halves), result[0]


def _row(of: _Maps, variant: Variant, budget: Budget, seed: int) -> dict[str, float]:
    """One training, and how wrong it is."""
    (pool, reference), how = _data(of), of.recipe.how
    if variant.by_area:
        pool = drawn_by_area(pool)
    learner = variant.learner(reference.medium, pool, seed)
    source = pool.batches(how.n_groups, how.n_queries)
    spent = fit(learner, source, Within(budget, how), seed, threads=None).spent
    e = model_error(model_of(learner, reference.medium), reference)
    row = {"threads": torch.get_num_threads(), "kB": 4e-3 * sum(p.numel() for p in learner.parameters())}
    row |= {key: getattr(spent, key) for key in ("steps", "samples", "seconds")}
    row |= {"error": e.error, "raw": e.raw, "noise": e.noise, "bias": e.bias}
    return row | {f"r {d}": v for d, v in e.by_decade.items()}


def summary(table: pandas.DataFrame) -> pandas.DataFrame:
    """Per budget and variant, over the seeds: kB, means, and standard deviations of error and bias."""
    import pandas

    rows, decades = [], [c for c in table if c.startswith("r ")]
    for (budget, name), t in table.groupby(["budget", "variant"], sort=False):
        row = {"budget": budget, "variant": name, "kB": t["kB"].iloc[0], "seeds": len(t)}
        row |= {key: t[key].mean() for key in ("samples", "seconds")}
        for key in ("error", "bias"):
            row |= {key: t[key].mean(), f"{key}_sd": t[key].std(ddof=1) if len(t) > 1 else math.nan}
        rows.append(row | {key: t[key].mean() for key in ("noise", *decades)})
    return pandas.DataFrame(rows)


def caption(budgets: Sequence[Budget], threads: int) -> str:
    """What the table of trainings on so many threads says, and what it does not."""
    within = ", or ".join(map(str, budgets))
    return (
        f"Each row changes one thing in the row above it. All are trained on the same maps, for {within} each, on "
        f"{threads} thread(s), and asked for unseen pairs of directions. samples: cells seen, two points of each; "
        f"error, bias: energy-weighted, order >= 2, blocks of {BLOCK} x {BLOCK} cells, noise removed, up to 12 L; ± is "
        "the standard deviation over seeds; r: the error by decades of distance, mean free paths. The first row is the "
        "paper's set-up (inputs, size, loss) at this budget, with our maps, optimiser and rate: the authors trained "
        "2118 s on an RTX 4090, so it is not their converged error and says nothing against their figures. The "
        "table shows the gain of each change where training is short. The training of the universal network, done once "
        "for all media, is not counted."
    )
