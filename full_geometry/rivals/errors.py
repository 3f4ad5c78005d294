"""The table of models: errors of one object after equal CPU time, data included.

`full_geometry`, S = alpha p, and the paper's network with its points from walks (as it was trained) and uniform.
"""

from __future__ import annotations

from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from full_geometry.alpha_p.training import fit_alpha_p
from full_geometry.flow.training import FlowRecipe
from full_geometry.half_space import HalfSpace, HalfSpaceTransport
from full_geometry.learning import model_errors, radiance
from full_geometry.learning.pairs import Proposals
from full_geometry.learning.training import train_by_cpu
from full_geometry.paper.errors import POINTS, paper_errors
from full_geometry.paper.network import PaperRecipe, fit_paper
from full_geometry.subject import Subject

if TYPE_CHECKING:
    import pandas

__all__ = ["BACKBONE", "error_table"]

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
    proposals = Proposals(subject, HalfSpace(subject, BACKBONE)).with_patches(learnt.sampler)
    tell("S = alpha p", 1)
    models = {BACKBONE: HalfSpaceTransport(subject, BACKBONE), "full_geometry": learnt.model}
    models["S = alpha p"] = fit_alpha_p(subject, FlowRecipe(seconds=seconds), seed)
    for key, model in models.items():
        found = model_errors.measure(subject, model, proposals, truth=truth, samples=samples, seed=seed)
        rows += [{"model": key, **row._asdict()} for row in found]
    tell("full_geometry_paper", 2)
    net, _ = fit_paper(subject, PaperRecipe(n=n, seconds=seconds), seed)
    for points in POINTS:
        found = paper_errors(subject, net, truth, points=points, seed=seed)
        rows += [{"model": f"full_geometry_paper, points {points}", **row._asdict()} for row in found]
    tell("models", 4)
    return pandas.DataFrame(rows)
