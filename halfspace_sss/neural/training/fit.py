"""Fitting of a learner, whatever it learns from: Adam, and checkpoints from which a killed run goes on bit for bit."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch

from halfspace_sss.neural.training import checkpoint
from halfspace_sss.neural.training.schedules import Schedule, Spent
from halfspace_sss.progress import NamedProgress

__all__ = ["Fitted", "Learner", "Source", "fit"]

BETAS, CLIP = (0.9, 0.99), 1.0
Source = Callable[[torch.Generator], Any]  # the next batch; all chance in it is drawn from the generator


class Learner(Protocol):
    """A torch module that knows its loss for a batch of its source."""

    def parameters(self) -> Any: ...

    def loss(self, batch: Any) -> torch.Tensor: ...


class Fitted(NamedTuple):
    """Validations (step, loss, error, seconds) and what was spent."""

    history: list[dict[str, float]]
    spent: Spent


def fit(
    learner: Learner,
    source: Source,
    schedule: Schedule,
    seed: int,
    *,
    checkpoint: Path | None = None,
    validate: Callable[[], float] | None = None,
    target_error: float | None = None,
    progress: NamedProgress | None = None,
    threads: int | None = 1,
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
        progress: called with ("training", steps done, steps in all), for a schedule of steps.
        threads: of torch, None for as many as it has; batches of small networks lose by being shared, and with one
            thread sums keep their order.

    Raises:
        ValueError: the checkpoint is damaged.
    """
    run = _Run(learner, schedule, seed)
    if checkpoint and checkpoint.exists():
        run.load(checkpoint, target_error)
    saved, before = time.monotonic(), torch.get_num_threads()
    torch.set_num_threads(threads or before)
    while not run.over:
        run.advance(source)
        if validate and (run.step % schedule.validate_every == 0 or run.over):
            run.validated(validate(), target_error)
        if progress and (run.step % 50 == 0 or run.over):
            progress("training", run.step, schedule.steps)
        if checkpoint and (time.monotonic() - saved > schedule.checkpoint_every or run.done):
            run.save(checkpoint)
            saved = time.monotonic()
    torch.set_num_threads(before)
    return Fitted(run.history, run.spent)


class _Run:
    """State of a fit: the numbers, Adam's moments, the generator, the history."""

    def __init__(self, learner: Any, schedule: Schedule, seed: int) -> None:
        self.learner, self.schedule = learner, schedule
        self.parameters = [p for p in learner.parameters() if p.requires_grad]
        self.adam = torch.optim.Adam(self.parameters, lr=schedule.rate_at(Spent(0, 0, 0.0)), betas=BETAS)
        self.generator = torch.Generator().manual_seed(seed)
        self.step, self.loss, self.done = 0, math.nan, False
        self.history: list[dict[str, float]] = []
        self.started, self.seconds = time.monotonic(), 0.0

    @property
    def spent(self) -> Spent:
        return Spent(self.step, self.step * self.schedule.per_step, self.seconds)

    @property
    def over(self) -> bool:
        return self.done or self.schedule.share(self.spent) >= 1

    def advance(self, source: Source) -> None:
        """One step."""
        for group in self.adam.param_groups:
            group["lr"] = self.schedule.rate_at(self.spent)
        loss = self.learner.loss(source(self.generator))
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, CLIP)
        self.adam.step()
        self.step, self.seconds = self.step + 1, time.monotonic() - self.started
        value = float(loss.detach())
        self.loss = value if math.isnan(self.loss) else 0.99 * self.loss + 0.01 * value

    def validated(self, error: float, target_error: float | None) -> None:
        seconds = time.monotonic() - self.started
        self.history.append({"step": self.step, "loss": self.loss, "error": error, "seconds": seconds})
        self.done = self._reached(target_error)

    def _reached(self, target_error: float | None) -> bool:
        return target_error is not None and bool(self.history) and self.history[-1]["error"] <= target_error

    def save(self, path: Path) -> None:
        rows = [[h[k] for k in ("step", "loss", "error", "seconds")] for h in self.history]
        checkpoint.write(
            path, checkpoint.tensors_of(self.adam, self.parameters),
            generator=self.generator.get_state(), counter=torch.tensor([self.step, self.loss], dtype=torch.float64),
            history=torch.tensor(rows, dtype=torch.float64).reshape(-1, 4),
        )  # fmt: skip

    def load(self, path: Path, target_error: float | None) -> None:
        """Go on from a checkpoint; ValueError if it is damaged or of another architecture."""
        with checkpoint.gone_on_with(path, checkpoint.tensors_of(self.adam, self.parameters)) as stored:
            self.generator.set_state(stored["generator"])
            step, self.loss = stored["counter"].tolist()
            rows = stored["history"].tolist()
        self.step = int(step)
        self.history = [{"step": int(step), "loss": a, "error": b, "seconds": c} for step, a, b, c in rows]
        self.done = self._reached(target_error)
        self.started -= self.history[-1]["seconds"] if self.history else 0.0
