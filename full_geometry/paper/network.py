"""The network: 5 + 8 N inputs, three layers of 256 with LeakyReLU, radiance as output, fitted by the MSE.

Inputs: x_o and the two angles of w_o, and for each of N samples x_i, the two angles of w_i and the light L_i from
there; target mean_j T_j L_j over N walks that end at (x_j, w_j).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from full_geometry.features import Frame
from full_geometry.identity import frame_of
from full_geometry.learning.device import one_thread
from full_geometry.learning.exits import trace_exits
from full_geometry.paper.lights import Light, random_lights
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["PaperNetwork", "PaperRecipe", "Samples", "fit_paper", "walk_samples"]

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
        check_interval("seconds", self.seconds, 1e-3, 1e6)
        for name in ("n", "batch", "exits", "reuse"):
            check_count(name, getattr(self, name), 1)
        check_count("steps", 1 if self.steps is None else self.steps, 1)


@dataclass(frozen=True, eq=False)
class Samples:
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
        seed: of the numbers at the start.
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

    def radiance(self, samples: Samples, light: Light) -> np.ndarray:
        """Radiance (m, channels) of samples in a light."""
        with torch.no_grad():
            L = torch.from_numpy(light(samples.w))
            return self(torch.from_numpy(samples.exit), torch.from_numpy(samples.points), L).numpy()


def placed(frame: Frame, at: SurfacePoint, n: int) -> np.ndarray:
    """Position over the radius and the angles of w, over pi: (n, 5)."""
    import drjit as dr
    import mitsuba as mi

    p, w = frame.position(at.p), mi.Vector3f(frame.direction(at.w))
    columns = [*p, dr.acos(dr.clip(w.z, -1, 1)) / dr.pi, dr.atan2(w.y, w.x) / dr.pi]
    dr.eval(columns)
    return np.stack([np.broadcast_to(c.numpy(), n) for c in columns], axis=1).astype(np.float32)


def walk_samples(subject: Subject, frame: Frame, exits: SurfacePoint, n: int, seed: tuple[int, ...]) -> Samples:
    """N walks of each exit, as the paper's samples; walks that end inside keep T = 0 and a place of their own."""
    import drjit as dr
    import mitsuba as mi

    m = dr.width(exits.p)
    starts = exits.gather(dr.arange(mi.UInt32, m * n) // n)
    ends = trace_exits(subject, starts, seed)
    lost = dr.max(ends.T) <= 0
    here = SurfacePoint(*(dr.select(lost, a, b) for a, b in zip(starts, ends.at)))
    points = placed(frame, here, m * n).reshape(m, n, 5)
    w, T = (np.array(v, dtype=np.float32).T.reshape(m, n, -1) for v in (here.w, ends.T))
    return Samples(placed(frame, exits, m), points, w, np.ascontiguousarray(T))


@one_thread()
def fit_paper(
    subject: Subject, recipe: PaperRecipe | None = None, seed: int = 0,
    progress: Callable[[str, int, int], Any] | None = None,
) -> tuple[PaperNetwork, int]:  # fmt: skip
    """The network of an object after the recipe's CPU seconds, or when it stops; and its steps.

    Args:
        subject: the object.
        recipe: N, seconds and sizes.
        seed: of everything.
        progress: called with (what, done, total).
    """
    import mitsuba as mi

    recipe, frame, channels = recipe or PaperRecipe(), frame_of(subject), len(subject.media)
    net = PaperNetwork(recipe.n, channels, seed)
    adam = torch.optim.Adam(net.parameters(), lr=recipe.rate)
    rng, began, steps, below, chunk = np.random.default_rng([seed, 80]), time.process_time(), 0, 0, 0

    def ends() -> bool:
        spent = time.process_time() - began > recipe.seconds if recipe.steps is None else steps >= recipe.steps
        return spent or below >= FOR_STEPS

    while not ends():
        exits = subject.random_points(generator(mi, recipe.exits, pass_seed(seed, 81, chunk)))
        samples = walk_samples(subject, frame, exits, recipe.n, (seed, 82, chunk))
        for _ in range(recipe.reuse):
            for rows in np.array_split(rng.permutation(recipe.exits), max(recipe.exits // recipe.batch, 1)):
                error = _step(net, adam, samples, rows, rng)
                below = below + 1 if error < ENOUGH else 0
                steps += 1
                if ends():
                    return net, steps
        chunk += 1
        if progress:
            progress("training", min(int(time.process_time() - began), int(recipe.seconds)), int(recipe.seconds))
    return net, steps


def _step(net: PaperNetwork, adam: Any, samples: Samples, rows: np.ndarray, rng: np.random.Generator) -> float:
    """One step under random light; returns the MSE."""
    light = random_lights(len(rows), samples.T.shape[2], rng)
    L = light(samples.w[rows])
    target = torch.from_numpy((samples.T[rows] * L).mean(axis=1))
    exit, points = torch.from_numpy(samples.exit[rows]), torch.from_numpy(samples.points[rows])
    loss = nn.functional.mse_loss(net(exit, points, torch.from_numpy(L)), target)
    adam.zero_grad(set_to_none=True)
    loss.backward()
    adam.step()
    return float(loss.detach())
