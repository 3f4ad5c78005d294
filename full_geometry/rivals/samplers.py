"""The table of samplers: variance of a sample, its time and their product, under each light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from full_geometry.entries import AREA_SHARE, LearntProposals
from full_geometry.flow.lights import LIGHTINGS, Lighting, lighting
from full_geometry.flow.sampler import FlowProposals
from full_geometry.flow.training import FlowRecipe, fit_flow, fit_patches
from full_geometry.patch_table import PatchTable
from full_geometry.rivals.comparing import costs, spread
from full_geometry.scene import LearntTransport
from full_geometry.storing import Learnt
from halfspace_sss.rendering.transport.half_space import HalfSpaceProposals
from halfspace_sss.rendering.transport.positions import PositionSampler
from halfspace_sss.rendering.transport.protocols import Means, Proposals
from halfspace_sss.rendering.transport.radial_table import RadialTable

if TYPE_CHECKING:
    import pandas

__all__ = ["SAMPLERS", "sampler_table", "samplers"]

SAMPLERS = (
    "uniform", "probes", "patches by network", "patches", "patches and probes", "flow", "patches, light", "flow, light",
)  # fmt: skip
SAMPLES_OF_AN_EXIT = (1, 8)


def samplers(learnt: Learnt, recipe: FlowRecipe, light: Lighting, flow: Any, seed: int = 0) -> dict[str, Proposals]:
    """All ways of drawing entries of a trained object, by name.

    Args:
        learnt: the object.
        recipe: of what is fitted to the light.
        light: that "..., light" are fitted to, walks times its light.
        flow: fitted to S alone.
        seed: of the fits.
    """
    model, patches, _ = learnt
    found, sign = model.subject.found, model.subject.found.sign
    backbone = model.start.models
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], found.size)
    probes = PositionSampler(replace(found, pieces=None), table, model.subject.points, AREA_SHARE)
    lit = fit_patches(learnt, recipe, light=light, seed=seed)
    lit_flow = fit_flow(learnt._replace(sampler=lit), recipe, light=light, seed=seed)
    by_face, lit_by_face = PatchTable(patches), PatchTable(lit)
    return {
        "uniform": HalfSpaceProposals(replace(probes, area_share=1.0), backbone[0]),
        "probes": HalfSpaceProposals(probes, backbone[0]),
        "patches by network": LearntProposals(patches, probes, 1.0, sign),
        "patches": LearntProposals(patches, probes, 1.0, sign, by_face),
        "patches and probes": LearntProposals(patches, probes, 0.5, sign, by_face),
        "flow": FlowProposals(flow, sign, by_face),
        "patches, light": LearntProposals(lit, probes, 1.0, sign, lit_by_face),
        "flow, light": FlowProposals(lit_flow, sign, lit_by_face),
    }


def sampler_table(
    learnt: Learnt, recipe: FlowRecipe, *, exits: int = 256, samples: int = 2048, seed: int = 0,
    progress: Callable[[str, int, int], Any] | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Rows of light, sampler, V, seconds a million of an exit and of a sample, and V t for 1 and 8 samples an exit.

    Args:
        learnt: the object.
        recipe: of the flow, and of what is fitted to each light.
        exits, samples: of the variance.
        seed: of everything.
        progress: called with (what, done, total).
    """
    import pandas

    subject, rows = learnt.model.subject, []
    transport = LearntTransport(learnt.model, ())
    flow, total = fit_flow(learnt, recipe, seed=seed), len(LIGHTINGS) * len(SAMPLERS)
    for name in LIGHTINGS:
        light = lighting(name, subject)
        means = {key: Means(transport, p) for key, p in samplers(learnt, recipe, light, flow, seed).items()}
        spent = costs(subject, means, light)
        for key, each in means.items():
            V = spread(subject, each, light, exits=exits, samples=samples, seed=seed)
            row = {"light": name, "sampler": key, "V": V.variance, "t exit": spent[key].exit, "t": spent[key].sample}
            row |= {f"V t, {n} of an exit": V.variance * spent[key].of(n) for n in SAMPLES_OF_AN_EXIT}
            rows.append({**row, "mean": float(V.mean.mean())})
            if progress:
                progress(f"{name}, {key}", len(rows), total)
    return pandas.DataFrame(rows)
