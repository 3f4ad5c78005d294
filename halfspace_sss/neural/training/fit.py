"""Fitting of a learner, whatever it learns from: Adam, and checkpoints from which a killed run goes on bit for bit.

A schedule says how long, and at which rate. A folder of unfinished work says to which run it belongs; another run is
refused.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import torch

import halfspace_sss
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.store import to_json
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import JsonDict, read_text, write_atomically

Tensors = dict[str, torch.Tensor]
RUN, CHECKPOINT = "run.json", "checkpoint.safetensors"
WORK = ("maps-*.npy", "reflectances-*.npy", CHECKPOINT)


def claim(folder: Path, **run: object) -> None:
    """Write in `folder` which run it belongs to; where that is written already, check that it is the same.

    Args:
        folder: for maps and checkpoint; made if it is not there.
        run: all that the result follows from (medium, recipe, seed, ...), ready for JSON; the version is added.

    Raises:
        ValueError: the folder holds the work of another run, or work of an unknown one.
    """
    run = {"version": halfspace_sss.__version__, **run}
    place = folder / RUN
    if not place.exists():
        left = sorted(path.name for pattern in WORK for path in folder.glob(pattern))
        if left:
            raise ValueError(f"{folder}: work must come from a known run, got {left[0]} without {RUN}; remove it")
        write_atomically(place, to_json(run))
        return
    wanted, result = _flat(json.loads(to_json(run))), _flat(_read(place))
    for key in sorted(wanted.keys() | result.keys()):
        if wanted.get(key) != result.get(key):
            asked, stands = wanted.get(key), result.get(key)
            raise ValueError(
                f"{place}: {key} must be {asked!r} to go on with this work, got {stands!r}; name another folder"
            )


def _read(place: Path) -> JsonDict:
    try:
        run = json.loads(read_text(place))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{place}: must be a readable JSON file, remove the folder to start anew: {error}") from error
    if not isinstance(run, dict):
        raise ValueError(f"{place}: must be a JSON object, remove the folder to start anew, got {type(run).__name__}")
    return run


def _flat(tree: JsonDict) -> JsonDict:
    """Leaves by their path, {"recipe.how.steps": 100}."""
    leaves = {}
    for key, value in tree.items():
        inner = _flat(value) if isinstance(value, dict) else None
        leaves |= {f"{key}.{k}": v for k, v in inner.items()} if inner else {key: value}
    return leaves


def write_checkpoint(path: Path, tensors: Tensors, **more: torch.Tensor) -> None:
    """A checkpoint of tensors on any device, and of others that are read back by name."""
    from safetensors.torch import save

    state = {name: tensor.to("cpu", copy=True) for name, tensor in {**tensors, **more}.items()}
    write_atomically(path, save({**state, "checksum": _checksum(state)}))


@contextmanager
def gone_on_with(path: Path, tensors: Tensors) -> Iterator[Tensors]:
    """Fill tensors from a checkpoint; yields all that it holds, for the reading of the others.

    Raises:
        ValueError: it is damaged or of another run, also where that shows in the reading of the others.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        stored = load(path.read_bytes())
        if not torch.equal(stored.pop("checksum"), _checksum(stored)):
            raise RuntimeError("it was altered")
        for name, tensor in tensors.items():
            if stored[name].shape != tensor.shape:
                raise RuntimeError(f"{name} must have shape {tuple(tensor.shape)}")
            tensor.copy_(stored[name])
        yield stored
    except (SafetensorError, KeyError, RuntimeError, OSError) as error:
        raise ValueError(f"{path}: checkpoint cannot be used, remove it to start anew: {error}") from error


def _checksum(tensors: Tensors) -> torch.Tensor:
    """SHA-256 of names and contents, as 32 bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return torch.tensor(list(digest.digest()), dtype=torch.uint8)


LAST_RATE = 0.002  # of the largest
WARM_UP_STEPS = 200


def warm_up(steps: int, over: int = WARM_UP_STEPS) -> float:
    """What the rate is multiplied by after some steps: it rises evenly over the first ones."""
    return min(1.0, (steps + 1) / over)


def cosine(rate: float, share: float, last: float = LAST_RATE) -> float:
    """A rate that falls by a cosine to a part `last` of it, when a share of the fit is done."""
    return rate * (last + (1 - last) * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


class Spent(NamedTuple):
    """Steps of the optimiser, samples (cells seen, two points of each), seconds and CPU seconds."""

    steps: int
    samples: int
    seconds: float
    cpu_seconds: float


class Schedule(Protocol):
    """When a fit ends, and the learning rate until then."""

    per_step: int  # samples
    checkpoint_every: float
    validate_every: int

    def share(self, spent: Spent) -> float:
        """The part of the fit that is done, 1 or more at its end."""

    def rate_at(self, spent: Spent) -> float:
        """Learning rate of the next step."""

    def done(self, spent: Spent) -> tuple[int, int]:
        """What is done, and what there is to do."""


@dataclass(frozen=True)
class Fit:
    """A number of steps.

    Args:
        steps: of the optimiser, each on one batch.
        n_groups, n_queries: groups of a batch, and cells of each group, each asked at two points.
        rate: largest learning rate; it rises over the first 200 steps and falls by a cosine.
        checkpoint_every: seconds between checkpoints.
        validate_every: steps between two calls of the validation.
    """

    steps: int
    n_groups: int = 32
    n_queries: int = 128
    rate: float = 4e-3
    checkpoint_every: float = 20.0
    validate_every: int = 2000

    def __post_init__(self) -> None:
        for name in ("steps", "n_groups", "n_queries", "validate_every"):
            check_count(name, getattr(self, name), 1)
        check_interval("rate", self.rate, 1e-8, 1.0)
        check_interval("checkpoint_every", self.checkpoint_every, 0.0, 1e9)

    @property
    def per_step(self) -> int:
        return self.n_groups * self.n_queries

    def share(self, spent: Spent) -> float:
        return spent.steps / self.steps

    def rate_at(self, spent: Spent) -> float:
        return cosine(self.rate * warm_up(spent.steps), self.share(spent))

    def done(self, spent: Spent) -> tuple[int, int]:
        return spent.steps, self.steps


BETAS, CLIP = (0.9, 0.99), 1.0
Batch = object  # what a source gives and its learner takes
Source = Callable[[torch.Generator], Batch]  # the next batch; all chance in it is drawn from the generator


class Learnable(Protocol):
    """A torch module that knows its loss for a batch of its source."""

    def parameters(self) -> Iterable[torch.nn.Parameter]: ...

    def loss(self, batch: Batch) -> torch.Tensor: ...


@contextmanager
def torch_threads(n: int | None = 1) -> Iterator[None]:
    """Torch with so many threads, None for as many as it has.

    Layers of small networks gain little by being shared, and threads that wait spin.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(n or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Descent:
    """Steps of Adam with clipped gradients, and a running mean of the numbers.

    Args:
        learner: what is fitted; a module where there is a mean.
        betas: of Adam.
        clip: largest norm of the gradient.
        parts: modules whose gradients are clipped each by its own norm; by default all together.
        average: share of the running mean that a step keeps, less in the first steps; None for no mean.
        fused: the fused kernels of torch.
    """

    def __init__(
        self,
        learner: Learnable,
        *,
        betas: tuple[float, float] = BETAS,
        clip: float = CLIP,
        parts: Sequence[torch.nn.Module] | None = None,
        average: float | None = None,
        fused: bool = False,
    ) -> None:
        self.parameters: list[torch.nn.Parameter] = [p for p in learner.parameters() if p.requires_grad]
        self.clipped: list[list[torch.nn.Parameter]] = (
            [list(part.parameters()) for part in parts] if parts else [self.parameters]
        )
        self.clip = clip
        self.kept = average
        self.average: torch.nn.Module | None = None if average is None else copy.deepcopy(learner)
        self.adam: torch.optim.Adam = torch.optim.Adam(self.parameters, betas=betas, fused=fused or None)
        self.steps: int = 0

    def step(self, loss: torch.Tensor, rate: float) -> float:
        """One step down a loss, at a learning rate; returns the loss."""
        for group in self.adam.param_groups:
            group["lr"] = rate
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        for parameters in self.clipped:
            torch.nn.utils.clip_grad_norm_(parameters, self.clip)
        self.adam.step()
        self.steps += 1
        if self.average is not None:
            share = 1 - min(self.kept, (1 + self.steps) / (10 + self.steps))
            with torch.no_grad():
                torch._foreach_lerp_(list(self.average.parameters()), self.parameters, share)
        return float(loss.detach())

    def tensors(self) -> dict[str, torch.Tensor]:
        """Numbers, moments and means by name; changing the tensors in place changes the fit."""
        tensors = {}
        for k, p in enumerate(self.parameters):
            state = self.adam.state[p]
            if not state:
                at = p.device if self.adam.defaults["fused"] else None  # where a fused step counts
                zeros = {name: torch.zeros_like(p) for name in ("exp_avg", "exp_avg_sq")}
                state.update(step=torch.tensor(0.0, device=at), **zeros)
            tensors[f"{k}.value"] = p.data
            tensors |= {f"{k}.{name}": state[name] for name in ("step", "exp_avg", "exp_avg_sq")}
        means = self.average.parameters() if self.average is not None else ()
        return tensors | {f"{k}.mean": mean.data for k, mean in enumerate(means)}


class Fitted(NamedTuple):
    """Validations (step, loss, error, seconds) and what was spent."""

    history: list[dict[str, float]]
    spent: Spent


def fit(
    learner: Learnable,
    source: Source,
    schedule: Schedule,
    seed: int,
    *,
    checkpoint: Path | None = None,
    validate: Callable[[], float] | None = None,
    target_error: float | None = None,
    progress: NamedProgress | None = None,
    threads: int | None = 1,
    descent: Descent | None = None,
) -> Fitted:
    """Fit in place.

    Args:
        learner: what is fitted.
        source: gives the batches.
        schedule: how long, and at which rate.
        seed: of the batches.
        checkpoint: file to go on from if it is there, and to write as time goes by.
        validate: error of the learner as it is; called every `schedule.validate_every` steps and at the end.
        target_error: stop once what `validate` gives has come down to it.
        progress: called with ("training", done, total) of the schedule: steps, or seconds.
        threads: of torch, None for as many as it has; batches of small networks lose by being shared, and with one
            thread sums keep their order.
        descent: of the learner, where it is not the usual one.

    Raises:
        ValueError: the checkpoint is damaged.
    """
    run = _FitState(learner, schedule, seed, descent or Descent(learner))
    if checkpoint and checkpoint.exists():
        run.load(checkpoint, target_error)
    saved = time.monotonic()
    with torch_threads(threads):
        while not run.over:
            run.advance(source)
            if validate and (run.step % schedule.validate_every == 0 or run.over):
                run.validated(validate(), target_error)
            if progress and (run.step % 50 == 0 or run.over):
                progress("training", *schedule.done(run.spent))
            if checkpoint and (time.monotonic() - saved > schedule.checkpoint_every or run.done):
                run.save(checkpoint)
                saved = time.monotonic()
    return Fitted(run.history, run.spent)


class _FitState:
    """The numbers, Adam's moments, the generator, the history."""

    def __init__(self, learner: Learnable, schedule: Schedule, seed: int, descent: Descent) -> None:
        self.learner, self.schedule, self.descent = learner, schedule, descent
        self.generator = torch.Generator().manual_seed(seed)
        self.loss, self.done = math.nan, False
        self.history: list[dict[str, float]] = []
        self.started, self.seconds = time.monotonic(), 0.0
        self.cpu_started, self.cpu_seconds = time.process_time(), 0.0

    @property
    def step(self) -> int:
        return self.descent.steps

    @property
    def spent(self) -> Spent:
        return Spent(self.step, self.step * self.schedule.per_step, self.seconds, self.cpu_seconds)

    @property
    def over(self) -> bool:
        return self.done or self.schedule.share(self.spent) >= 1

    def advance(self, source: Source) -> None:
        rate = self.schedule.rate_at(self.spent)
        value = self.descent.step(self.learner.loss(source(self.generator)), rate)
        self.seconds, self.cpu_seconds = time.monotonic() - self.started, time.process_time() - self.cpu_started
        self.loss = value if math.isnan(self.loss) else 0.99 * self.loss + 0.01 * value

    def validated(self, error: float, target_error: float | None) -> None:
        seconds = time.monotonic() - self.started
        self.history.append({"step": self.step, "loss": self.loss, "error": error, "seconds": seconds})
        self.done = self._reached(target_error)

    def _reached(self, target_error: float | None) -> bool:
        return target_error is not None and bool(self.history) and self.history[-1]["error"] <= target_error

    def save(self, path: Path) -> None:
        rows = [[h[k] for k in ("step", "loss", "error", "seconds")] for h in self.history]
        write_checkpoint(
            path, self.descent.tensors(),
            generator=self.generator.get_state(), counter=torch.tensor([self.step, self.loss], dtype=torch.float64),
            history=torch.tensor(rows, dtype=torch.float64).reshape(-1, 4),
        )  # fmt: skip

    def load(self, path: Path, target_error: float | None) -> None:
        """Go on from a checkpoint; ValueError if it is damaged or of another architecture."""
        with gone_on_with(path, self.descent.tensors()) as stored:
            self.generator.set_state(stored["generator"])
            step, self.loss = stored["counter"].tolist()
            rows = stored["history"].tolist()
        self.descent.steps = int(step)
        self.history = [{"step": int(step), "loss": a, "error": b, "seconds": c} for step, a, b, c in rows]
        self.done = self._reached(target_error)
        self.started -= self.history[-1]["seconds"] if self.history else 0.0
