"""Fitting a learner to a pool of maps: Adam, cosine decay, checkpoints from which a killed run goes on bit for bit."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.training.pool import Batch, MapPool
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import write_atomically

__all__ = ["Fit", "Learner", "fit"]

BETAS, CLIP, LAST_RATE, WARM_UP = (0.9, 0.99), 1.0, 0.002, 200


class Learner(Protocol):
    """A torch module that knows its loss."""

    def loss(self, batch: Batch) -> torch.Tensor: ...


@dataclass(frozen=True)
class Fit:
    """How a learner is fitted.

    Args:
        steps: of the optimiser, each on one batch.
        n_groups, n_queries: groups of a batch, and cells of each group, of which two points are asked.
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


def fit(
    learner: torch.nn.Module,
    pool: MapPool,
    how: Fit,
    seed: int,
    *,
    checkpoint: Path | None = None,
    validate: Callable[[], float] | None = None,
    target_error: float | None = None,
    progress: NamedProgress | None = None,
) -> list[dict[str, float]]:
    """Fit in place and return the history: step, loss, validation error, seconds.

    Args:
        checkpoint: file to go on from if it is there, and to write as time goes by.
        validate: error of the learner as it is; called every `how.validate_every` steps.
        target_error: stop once the validation error has come down to it.
        progress: called with ("training", steps done, steps in all).

    Raises:
        ValueError: the checkpoint is damaged.
    """
    run = _Run(learner, how, seed)
    if checkpoint and checkpoint.exists():
        run.load(checkpoint, target_error)
    saved, threads = time.monotonic(), torch.get_num_threads()
    torch.set_num_threads(1)  # batches of this size lose by being shared, and sums keep their order
    while run.step < how.steps and not run.done:
        run.advance(pool)
        if validate and (run.step % how.validate_every == 0 or run.step == how.steps):
            run.validated(validate(), target_error)
        if progress and (run.step % 50 == 0 or run.step == how.steps):
            progress("training", run.step, how.steps)
        if checkpoint and (time.monotonic() - saved > how.checkpoint_every or run.done):
            run.save(checkpoint)
            saved = time.monotonic()
    torch.set_num_threads(threads)
    return run.history


class _Run:
    """State of a fit: the numbers, Adam's moments, the generator, the history."""

    def __init__(self, learner: Any, how: Fit, seed: int) -> None:
        self.learner, self.how = learner, how
        self.parameters = [p for p in learner.parameters() if p.requires_grad]
        self.adam = torch.optim.Adam(self.parameters, lr=how.rate, betas=BETAS)
        self.generator = torch.Generator().manual_seed(seed)
        self.step, self.loss, self.done = 0, math.nan, False
        self.history: list[dict[str, float]] = []
        self.started = time.monotonic()

    def advance(self, pool: MapPool) -> None:
        """One step."""
        how = self.how
        decay = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * self.step / how.steps))
        for group in self.adam.param_groups:
            group["lr"] = how.rate * min(1.0, (self.step + 1) / WARM_UP) * decay
        loss = self.learner.loss(pool.batch(how.n_groups, how.n_queries, self.generator))
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, CLIP)
        self.adam.step()
        self.step += 1
        value = float(loss.detach())
        self.loss = value if math.isnan(self.loss) else 0.99 * self.loss + 0.01 * value

    def validated(self, error: float, target_error: float | None) -> None:
        seconds = time.monotonic() - self.started
        self.history.append({"step": self.step, "loss": self.loss, "error": error, "seconds": seconds})
        self.done = self._reached(target_error)

    def _reached(self, target_error: float | None) -> bool:
        return target_error is not None and bool(self.history) and self.history[-1]["error"] <= target_error

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything the next step depends on, by name; changing the tensors in place changes the run."""
        tensors = {}
        for k, p in enumerate(self.parameters):
            tensors[f"{k}.value"] = p.data
            state = self.adam.state[p]
            if not state:
                state.update(step=torch.tensor(0.0), exp_avg=torch.zeros_like(p), exp_avg_sq=torch.zeros_like(p))
            tensors |= {f"{k}.{name}": state[name] for name in ("step", "exp_avg", "exp_avg_sq")}
        return tensors

    def save(self, path: Path) -> None:
        from safetensors.torch import save

        rows = [[h[k] for k in ("step", "loss", "error", "seconds")] for h in self.history]
        extra = {
            "generator": self.generator.get_state(),
            "counter": torch.tensor([self.step, self.loss], dtype=torch.float64),
            "history": torch.tensor(rows, dtype=torch.float64).reshape(-1, 4),
        }
        state = {n: t.clone() for n, t in {**self._tensors(), **extra}.items()}
        write_atomically(path, save({**state, "checksum": _checksum(state)}))

    def load(self, path: Path, target_error: float | None) -> None:
        """Go on from a checkpoint; ValueError if it is damaged or of another architecture."""
        from safetensors import SafetensorError
        from safetensors.torch import load

        try:
            stored = load(path.read_bytes())
            if not torch.equal(stored.pop("checksum"), _checksum(stored)):
                raise RuntimeError("it was altered")
            for name, tensor in self._tensors().items():
                if stored[name].shape != tensor.shape:
                    raise RuntimeError(f"{name} must have shape {tuple(tensor.shape)}")
                tensor.copy_(stored[name])
            self.generator.set_state(stored["generator"])
            step, self.loss = stored["counter"].tolist()
            rows = stored["history"].tolist()
        except (SafetensorError, KeyError, RuntimeError) as error:
            raise ValueError(f"{path}: checkpoint cannot be used, remove it to start anew: {error}") from error
        self.step = int(step)
        self.history = [{"step": int(step), "loss": a, "error": b, "seconds": c} for step, a, b, c in rows]
        self.done = self._reached(target_error)
        self.started -= self.history[-1]["seconds"] if self.history else 0.0


def _checksum(tensors: dict[str, torch.Tensor]) -> torch.Tensor:
    """SHA-256 of names and contents, as 32 bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return torch.tensor(list(digest.digest()), dtype=torch.uint8)
