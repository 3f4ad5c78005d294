"""Tables of models of one object, and of base models that its network may begin with, at equal CPU time."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from figures.studies.alpha_p import fit_alpha_p
from figures.studies.flow_training import FlowRecipe
from figures.studies.paper_network import POINTS, PaperRecipe, fit_paper, paper_errors
from full_geometry.learning import model_errors
from full_geometry.learning.fitting import STANDARD
from full_geometry.learning.model_errors import measure, transport_of
from full_geometry.learning.training import train, train_by_cpu
from full_geometry.models.half_space import HalfSpace
from full_geometry.models.storing import KIND, Learnt
from full_geometry.object import radiance
from full_geometry.object.pairs import EntryProposals
from full_geometry.object.radiance import reference
from full_geometry.object.subject import Subject
from halfspace_sss.neural.store import load_weights

if TYPE_CHECKING:
    import pandas


# ---- The table of models: errors of one object after equal CPU time, data included -----------------
# `full_geometry`, S = alpha p, and the paper's network with its points from walks (as it was trained) and uniform.


BACKBONE = "better_dipole"


def error_table(
    scene: Any, name: str | None = None, *, seconds: float = 60.0, exits: int = 256, walks: int = 4096,
    samples: int = 4096, n: int = 16, seed: int = 0, progress: Callable[[str, int, int], Any] | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Rows of model, channel, light, error, standard error and ratio of the means.

    Args:
        scene: with the object.
        name: its id; may be left out where there is one.
        seconds: of CPU time for each model.
        exits, walks, samples: of the truth and of the models.
        n: incident samples of the paper's network.
        seed: of everything.
        progress: called with (what, done, total).
    """
    import pandas

    subject, rows = Subject.given(scene, None, None, name), []
    truth = radiance.reference(subject, exits, walks, seed)

    def tell(what: str, done: int) -> None:
        if progress:
            progress(what, done, 4)

    tell("full_geometry", 0)
    with TemporaryDirectory() as folder:
        learnt, _ = train_by_cpu(subject, seconds, folder, seed=seed)
    proposals = EntryProposals(subject, HalfSpace(subject, BACKBONE)).with_patches(learnt.sampler)
    tell("S = alpha p", 1)
    models = {BACKBONE: transport_of(subject, BACKBONE), "full_geometry": learnt.model}
    models["S = alpha p"] = fit_alpha_p(subject, FlowRecipe(seconds=seconds), seed)
    for key, model in models.items():
        errors = model_errors.measure(subject, model, proposals, truth=truth, samples=samples, seed=seed)
        rows += [{"model": key, **row._asdict()} for row in errors]
    tell("full_geometry_paper", 2)
    net, _ = fit_paper(subject, PaperRecipe(n=n, seconds=seconds), seed)
    for points in POINTS:
        errors = paper_errors(subject, net, truth, points=points, seed=seed)
        rows += [{"model": f"full_geometry_paper, points {points}", **row._asdict()} for row in errors]
    tell("models", 4)
    return pandas.DataFrame(rows)


# ----------------------------------------------------------------------------------------------------
# The table of starts: errors of one object against CPU time, by the model that its network begins with.

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
        proposals = EntryProposals(subject, HalfSpace(subject, STANDARD.start))
        proposals = proposals.with_patches(learnt.sampler if share else None)
        errors = measure(subject, learnt.model, proposals, truth=truth, samples=samples, seed=seed)
        rows += [{"start": start, "planned": share * seconds, **about, **row._asdict()} for row in errors]
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
