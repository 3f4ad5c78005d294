"""The paper's network of one object: lights, network, fit, errors, and the learner `full_geometry_paper`."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import nn

from full_geometry.learning.model_errors import LOBES, POWER, ExitRadiance, ExitTruth, RadianceError, compare, reference
from full_geometry.models.storing import Identity, frame_of, identify
from full_geometry.object.features import ObjectFrame
from full_geometry.object.pairs import trace_exits
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.neural.store import check_weights_folder, load_weights, save_weights, weights_folder
from halfspace_sss.neural.training.fit import ADAM, CpuSchedule, Descent, Objective, Source, fit
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import provenance
from halfspace_sss.rendering.object.objects import TranslucentObject, object_of
from halfspace_sss.rendering.object.points import SurfacePoint
from halfspace_sss.rendering.scenes.learners import LearntObject, ObjectError
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


# ---- How wrong the paper's network is, by the error measure of all models of an object -------------
# Its N points come from walks, as in training, or are uniform over the area with directions by the cosine: what a
# renderer has that knows nothing. Each exit is asked several times with new points, and the noise of their mean is
# taken out.

POINTS = ("walks", "uniform")


def paper_errors(
    obj: TranslucentObject,
    net: PaperNetwork,
    truth: ExitTruth,
    *,
    points: str = "walks",
    repeats: int = 16,
    seed: int = 0,
) -> list[RadianceError]:
    """Errors per channel, under constant light and lobes.

    Args:
        obj: the object.
        net: its network.
        truth: exits and their radiance.
        points: "walks" or "uniform".
        repeats: of each exit.
        seed: of the points.

    Raises:
        ValueError: an argument is out of range.
    """
    check_choice("points", points, POINTS)
    check_count("repeats", repeats, 2)
    return compare(estimate(obj, net, truth.exits, points, repeats, seed), truth.truth)


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
    m: Any = dr.width(exits.p)
    at = obj.random_points(generator(mi, m * n, pass_seed(*seed)))
    w = np.array(at.w, dtype=np.float32).T.reshape(m, n, 3)
    points = placed(frame, at, m * n).reshape(m, n, 5)
    return PaperSamples(placed(frame, exits, m), points, w, np.zeros((m, n, len(obj.media)), np.float32))


# ----------------------------------------------------------------------------------------------------
# The learner `full_geometry_paper`: the paper's network of an object of a scene, trained, kept and measured.

KIND = "full_geometry_paper"
EXITS, WALKS = 256, 4096  # of the truth


def save_network(folder: Path, identity: Identity, net: PaperNetwork, record: dict[str, Any]) -> Path:
    """Write the network of an object; returns the path."""
    arrays = {name: value.numpy().astype(np.float16) for name, value in net.state_dict().items()}
    whole = {"orders": "multiple", **identity.record(), "n": net.n, **record}
    path = Path(folder) / f"{KIND}-{identity.digest()}.safetensors"
    return save_weights(path, KIND, {**arrays, "anchors": identity.anchors.astype(np.float32)}, whole)


def load_network(obj: TranslucentObject, folder: Path | None = None) -> PaperNetwork:
    """The network of an object as it stands where it was trained.

    Raises:
        ValueError: the object has not been trained or has been moved since, or the file is damaged.
    """
    import torch

    here = identify(obj)
    path = (Path(folder) if folder else weights_folder()) / f"{KIND}-{here.digest()}.safetensors"
    if not path.exists():
        raise ValueError(
            f"object {obj.geometry.shape.id()!r} must be trained for {KIND}, got one that is not in {path.parent}; "
            f"`halfspace-sss train object --scene --model {KIND}` does it"
        )
    arrays, record = load_weights(path, KIND)
    anchors = arrays.pop("anchors")
    R, t = Identity(record["kind_of_shape"], record["topology"], anchors, dict(record["medium"])).pose(here)
    if not (np.allclose(R, np.eye(3), atol=1e-5) and np.allclose(t, 0, atol=1e-4 * np.ptp(anchors))):
        raise ValueError(f"{path}: object must stand where it was trained, got it moved or turned")
    net = PaperNetwork(record["n"], len(obj.media))
    net.load_state_dict({name: torch.from_numpy(value.astype(np.float32)) for name, value in arrays.items()})
    return net


def train(
    scene: Any, *, object: str | None = None, seconds: float = 60.0, target_error: float | None = None, seed: int = 0,
    folder: Path | None = None, work: Path | None = None, progress: NamedProgress | None = None,
    base_model: str | None = None,
) -> LearntObject:  # fmt: skip
    """The network of an object after so many seconds of CPU time, or where the paper's stop is met.

    Raises:
        ValueError: an argument is out of range, or one is given that this learner does not know.
    """
    check_interval("seconds", seconds, 1e-3, 1e7)
    check_count("seed", seed, 0)
    for name, value in (("target_error", target_error), ("work", work), ("base_model", base_model)):
        if value is not None:
            raise ValueError(f"{name} must be left out for {KIND}, got {value!r}")
    folder = check_weights_folder(folder)
    obj, began = object_of(scene, None, None, object), time.monotonic()
    net, steps = fit_paper(obj, PaperRecipe(seconds=seconds), seed, progress)
    rows = paper_errors(obj, net, reference(obj, EXITS, WALKS, seed), seed=seed)
    record = {"steps": steps, "seconds": seconds, "seed": seed, "errors": [row._asdict() for row in rows]}
    path = save_network(folder, identify(obj), net, {**record, "provenance": provenance(seed=seed)})
    name = obj.geometry.shape.id()
    return LearntObject(name, path, _rows(name, rows), steps, time.monotonic() - began)


def untrained(scene: Any) -> list[str]:
    """None: renders do not know this model."""
    return []


def errors(
    scene: Any, models: Sequence[str] = (KIND,), *, object: str | None = None, exits: int = EXITS, seed: int = 0,
    progress: NamedProgress | None = None,
) -> list[ObjectError]:  # fmt: skip
    """The errors of the network of an object over so many exits, its points from walks as it was trained."""
    for name in models:
        check_choice("model", name, (KIND,))
    obj = object_of(scene, None, None, object)
    net = load_network(obj)
    rows = paper_errors(obj, net, reference(obj, exits, WALKS, seed), seed=seed)
    return _rows(obj.geometry.shape.id(), rows)


def _rows(name: str, rows: list[RadianceError]) -> list[ObjectError]:
    channels = "RGB" if max(row.channel for row in rows) == 2 else ["mono"]
    return [ObjectError(name, channels[e.channel], KIND, e.light, e.error, e.standard_error, e.ratio) for e in rows]
