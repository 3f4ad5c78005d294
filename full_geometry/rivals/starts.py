"""The table of starts: errors of one object against CPU time, by the model that its network begins with."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from full_geometry.half_space import HalfSpace
from full_geometry.learning.fitting import STANDARD
from full_geometry.learning.model_errors import measure
from full_geometry.learning.pairs import Proposals
from full_geometry.learning.radiance import reference
from full_geometry.learning.training import train, train_by_cpu
from full_geometry.storing import KIND, Learnt
from full_geometry.subject import Subject
from halfspace_sss.neural.store import load_weights

if TYPE_CHECKING:
    import pandas

__all__ = ["STARTS", "start_table"]

STARTS = (STANDARD.start, "neural_shape")
TIMES = ((0.0, 1.0), (1 / 12, 1 / 4), (1 / 3, 1 / 2), (1.0, 1.0))  # shares of the time, and of a chunk of the recipe


def start_table(
    scene: Any, name: str | None = None, *, seconds: float = 60.0, exits: int = 256, walks: int = 4096,
    samples: int = 4096, seed: int = 0, progress: Callable[[str, int, int], Any] | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Rows of start, planned and spent CPU seconds, steps, channel, light, error, standard error, ratio of the means.

    Spent is all of a training but the truth: the pilot and the kernels that it compiles, data and fit.

    Args:
        scene: with the object.
        name: its id; may be left out where there is one.
        seconds: of CPU time of the longest training; the others have a third, a twelfth and none of it.
        exits, walks, samples: of the truth and of the models.
        seed: of everything.
        progress: called with (what, done, total).
    """
    import pandas

    subject, rows = Subject.given(scene, None, None, name), []
    truth = reference(subject, exits, walks, seed)
    runs = [(start, *time) for start in STARTS for time in TIMES]
    for k, (start, share, part) in enumerate(runs):
        if progress:
            progress(f"{start}, {share * seconds:.3g} s", k, len(runs))
        learnt, about = _learnt(subject, start, share * seconds, part, seed)
        proposals = Proposals(subject, HalfSpace(subject, STANDARD.start))
        proposals = proposals.with_patches(learnt.sampler if share else None)
        found = measure(subject, learnt.model, proposals, truth=truth, samples=samples, seed=seed)
        rows += [{"start": start, "planned": share * seconds, **about, **row._asdict()} for row in found]
    return pandas.DataFrame(rows)


def _learnt(subject: Subject, start: str, seconds: float, part: float, seed: int) -> tuple[Learnt, dict[str, Any]]:
    """A training with chunks of a part of those of the recipe; what it took."""
    recipe = replace(STANDARD.begun(start), chunk=int(STANDARD.chunk * part))
    with TemporaryDirectory() as folder:
        if seconds == 0:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = train(subject, seconds=0, recipe=recipe, seed=seed, folder=folder)
            return Learnt(found.model, found.sampler), {"seconds": 0.0, "steps": 0}
        learnt, path = train_by_cpu(subject, seconds, folder, seed=seed, recipe=recipe)
        record = load_weights(path, KIND)[1]
        return learnt, {"seconds": record["seconds"], "steps": record["steps"]}
