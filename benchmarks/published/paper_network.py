"""The paper's network of one object: lights, network, fit and errors."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import nn

from benchmarks.fits import ADAM, CpuSchedule, Objective
from full_geometry.geometry.points import SurfacePoint
from full_geometry.learning.model_errors import LOBES, POWER, ExitRadiance
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.exit_pairs import trace_exits
from full_geometry.transport.features import ObjectFrame
from full_geometry.transport.storing import frame_of
from halfspace_sss.checks import check_count
from halfspace_sss.neural.training.fit import Descent, Source, fit
from halfspace_sss.progress import NamedProgress
from halfspace_sss.tracing.walk import generator, pass_seed

# ----------------------------------------------------------------------------------------------------
# The network: 5 + 8 N inputs, three layers of 256 with LeakyReLU, radiance as output, fitted by the MSE.
# Inputs: x_o and the two angles of w_o, and for each of N samples x_i, the two angles of w_i and the light L_i from
# there; target mean_j T_j L_j over N walks that end at (x_j, w_j).


# Incident light for the paper's network: a constant and lobes max(0, w

MOST_LOBES = 3
FACTORS = (0.125, 8.0)  # of the augmentation by scale


@dataclass(frozen=True, eq=False)
class PaperLight:
    """Light of m exits, one for each.

    Args:
        base: constant part (m, channels).
        axes: of lobes (m, k, 3).
        powers: of the lobes (m, k).
        colours: of the lobes (m, k, channels).
    """

    base: np.ndarray
    axes: np.ndarray
    powers: np.ndarray
    colours: np.ndarray

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Radiance (m, n, channels) from directions w (m, n, 3)."""
        c = np.maximum(np.einsum("mni,mki->mnk", w, self.axes), 0) ** self.powers[:, None, :]
        return (self.base[:, None, :] + np.einsum("mnk,mkc->mnc", c, self.colours)).astype(np.float32)


def random_lights(m: int, channels: int, rng: np.random.Generator) -> PaperLight:
    """Lights of random lobes and colours, each times a random factor (augmentation by scale)."""
    axes = rng.standard_normal((m, MOST_LOBES, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    powers = 2.0 ** rng.uniform(0, 6, (m, MOST_LOBES))
    factor = np.exp(rng.uniform(*np.log(FACTORS), (m, 1)))
    on = rng.random((m, MOST_LOBES, 1)) < 0.6
    colours = on * rng.random((m, MOST_LOBES, channels)) * factor[:, :, None]
    return PaperLight(rng.random((m, channels)) * factor, axes, powers, colours)


def measured_lights(m: int, channels: int) -> list[PaperLight]:
    """Constant light and the four lobes of the measured errors, the same for m exits."""
    none = np.zeros((m, 1, 3))
    lights = [PaperLight(np.ones((m, channels)), none, np.ones((m, 1)), np.zeros((m, 1, channels)))]
    for axis in LOBES:
        axes = np.broadcast_to(axis, (m, 1, 3))
        lights.append(PaperLight(np.zeros((m, channels)), axes, np.full((m, 1), POWER), np.ones((m, 1, channels))))
    return lights


WIDTH, DEPTH = 256, 3
ENOUGH, FOR_STEPS = 1e-3, 100  # the stop: MSE below it for so many steps


@dataclass(frozen=True)
class PaperRecipe:
    """How it is fitted.

    Args:
        n: incident samples N of an exit.
        seconds: of CPU time of this process, data included.
        steps: instead of the seconds, where the end is to be the same every time.
        batch, rate: of a step.
        exits: that are made at once, N walks each. reuse: times that each is used, under new light.
    """

    n: int = 16
    seconds: float = 60.0
    steps: int | None = None
    batch: int = 256
    rate: float = 1e-3
    exits: int = 2**12
    reuse: int = 4

    def __post_init__(self) -> None:
        for name in ("n", "batch", "exits", "reuse"):
            check_count(name, getattr(self, name), 1)
        _ = self.schedule  # which refuses seconds, steps and rates out of range

    @property
    def schedule(self) -> CpuSchedule:
        return CpuSchedule(self.seconds, self.steps, self.rate)


@dataclass(frozen=True, eq=False)
class PaperSamples:
    """m exits with N incident samples each.

    Args:
        exit: x_o over the object's radius and two angles of w_o (m, 5).
        points: x_i likewise and two angles of w_i (m, N, 5).
        w: w_i in the world (m, N, 3).
        T: throughputs of the walks (m, N, channels).
    """

    exit: np.ndarray
    points: np.ndarray
    w: np.ndarray
    T: np.ndarray


class PaperNetwork(nn.Module):
    """The network of an object for N samples.

    Args:
        n: N.
        channels: of the light.
        seed: of the initial weights.
    """

    def __init__(self, n: int, channels: int = 3, seed: int = 0) -> None:
        super().__init__()
        self.n = n
        sizes = [5 + (5 + channels) * n, *[WIDTH] * DEPTH]
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            hidden = [m for i, j in zip(sizes, sizes[1:]) for m in (nn.Linear(i, j), nn.LeakyReLU())]
            self.layers = nn.Sequential(*hidden, nn.Linear(WIDTH, channels))

    def forward(self, exit: torch.Tensor, points: torch.Tensor, L: torch.Tensor) -> torch.Tensor:
        """Radiance (m, channels) of exits (m, 5) with points (m, N, 5) and light L (m, N, channels)."""
        both = torch.cat((points, L), dim=2).flatten(1)
        return self.layers(torch.cat((exit, both), dim=1))

    def radiance(self, samples: PaperSamples, light: PaperLight) -> np.ndarray:
        """Radiance (m, channels) of samples in a light."""
        with torch.no_grad():
            L = torch.from_numpy(light(samples.w))
            return self(torch.from_numpy(samples.exit), torch.from_numpy(samples.points), L).numpy()


def placed(frame: ObjectFrame, at: SurfacePoint, n: int) -> np.ndarray:
    """Position over the radius and the angles of w, over pi: (n, 5)."""
    p, w = frame.position(at.p), mi.Vector3f(frame.direction(at.w))
    columns = [*p, dr.acos(dr.clip(w.z, -1, 1)) / dr.pi, dr.atan2(w.y, w.x) / dr.pi]
    dr.eval(columns)
    return np.stack([np.broadcast_to(c.numpy(), n) for c in columns], axis=1).astype(np.float32)


def walk_samples(
    obj: TranslucentObject, frame: ObjectFrame, exits: SurfacePoint, n: int, seed: tuple[int, ...]
) -> PaperSamples:
    """N walks of each exit, as the paper's samples; walks that end inside keep T = 0 and a place of their own."""
    m = dr.width(exits.p)
    starts = exits.gather(dr.arange(mi.UInt32, m * n) // n)
    ends = trace_exits(obj, starts, seed)
    lost = dr.max(ends.T) <= 0
    here = SurfacePoint(*(dr.select(lost, a, b) for a, b in zip(starts[:5], ends.at)))
    points = placed(frame, here, m * n).reshape(m, n, 5)
    w, T = (np.array(v, dtype=np.float32).T.reshape(m, n, -1) for v in (here.w, ends.T))
    return PaperSamples(placed(frame, exits, m), points, w, np.ascontiguousarray(T))


def fit_paper(
    obj: TranslucentObject, recipe: PaperRecipe | None = None, seed: int = 0, progress: NamedProgress | None = None
) -> tuple[PaperNetwork, int]:
    """The network of an object after the recipe's CPU seconds, or when it stops; and its steps.

    Args:
        obj: the object.
        recipe: N, seconds and sizes.
        seed: of everything.
        progress: called with (what, done, total).
    """
    recipe = recipe or PaperRecipe()
    net, last = PaperNetwork(recipe.n, len(obj.media), seed), deque([np.inf] * FOR_STEPS, FOR_STEPS)

    def loss(batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
        *told, target = batch
        error = nn.functional.mse_loss(net(*told), target)
        last.append(float(error.detach()))
        return error

    learner = Objective(net, loss)
    fitted = fit(
        learner, _lit_batches(obj, recipe, seed), recipe.schedule, seed, validate=lambda: max(last),
        target_error=ENOUGH, progress=progress, descent=Descent(learner, betas=ADAM, clip=np.inf),
    )  # fmt: skip
    return net, fitted.spent.steps


def _lit_batches(obj: TranslucentObject, recipe: PaperRecipe, seed: int) -> Source:
    """Exits, their points and their light, each time a random one, and the radiance that walks give."""
    rng, frame = np.random.default_rng([seed, 80]), frame_of(obj)

    def batches() -> Iterator[tuple[torch.Tensor, ...]]:
        for chunk in count():
            exits = obj.random_points(generator(mi, recipe.exits, pass_seed(seed, 81, chunk)))
            samples = walk_samples(obj, frame, exits, recipe.n, (seed, 82, chunk))
            for _ in range(recipe.reuse):
                for rows in np.array_split(rng.permutation(recipe.exits), max(recipe.exits // recipe.batch, 1)):
                    L = random_lights(len(rows), samples.T.shape[2], rng)(samples.w[rows])
                    target = (samples.T[rows] * L).mean(axis=1)
                    yield tuple(map(torch.from_numpy, (samples.exit[rows], samples.points[rows], L, target)))

    source = batches()
    return lambda _: next(source)


# ---- Its radiance: points from walks, as in training, or uniform over the area with directions by the cosine, as a
# renderer has them that knows nothing. Each exit is asked several times with new points.


def estimate(
    obj: TranslucentObject, net: PaperNetwork, exits: SurfacePoint, points: str, repeats: int, seed: int = 0
) -> ExitRadiance:
    """Mean radiance of exits over repeats with new points, and its variance."""
    frame, m, means = frame_of(obj), dr.width(exits.p), []
    for k in range(repeats):
        if points == "walks":
            samples = walk_samples(obj, frame, exits, net.n, (seed, 95, k))
        else:
            samples = uniform_samples(obj, frame, exits, net.n, (seed, 96, k))
        lights = measured_lights(m, len(obj.media))
        means.append(np.stack([net.radiance(samples, light) for light in lights], axis=-1))
    values = np.array(means, dtype=float).transpose(0, 2, 1, 3)
    return ExitRadiance(values.mean(axis=0), values.var(axis=0, ddof=1) / repeats)


def uniform_samples(
    obj: TranslucentObject, frame: ObjectFrame, exits: SurfacePoint, n: int, seed: tuple[int, ...]
) -> PaperSamples:
    """N points uniform over the area for each exit; the throughputs are left out."""
    m: int = dr.width(exits.p)
    at = obj.random_points(generator(mi, m * n, pass_seed(*seed)))
    w = np.array(at.w, dtype=np.float32).T.reshape(m, n, 3)
    points = placed(frame, at, m * n).reshape(m, n, 5)
    return PaperSamples(placed(frame, exits, m), points, w, np.zeros((m, n, len(obj.media)), np.float32))
