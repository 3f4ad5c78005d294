"""Tables of equal-error times, of the time per sample and of the white furnace, as data frames and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.methods import VOLUMES, label, volume
from benchmarks.tables import in_markdown
from figures.computing.contenders import WALK
from figures.parts.part import Params, Row
from halfspace_sss.comparison.style import look

if TYPE_CHECKING:
    import pandas

LATE_ROULETTE = volume(200)  # the usual setting of volpathmis for media that hardly absorb
WANTED = 0.02  # noise of an image, root mean square over that of the image, at which a training is held against time
CERTAIN = 2.0  # standard errors by which an error must stand out of the noise of the truth
NOTES = """\
Cost is the mean squared error of the pixels of the object times CPU seconds, without compilation. A ratio is the cost
of `volpathmis`, at the best of its settings, over the method's cost: the time of `volpathmis` over the time of the
method for equal error.

| column | meaning |
|---|---|
| variance | ratio with the error about a long independent render by the same method |
| with bias | ratio with the error about the path traced image at this number of samples; bias makes it fall with time |
| bias | root mean square of the error after infinite time, over the image's |
| until | CPU seconds after which `volpathmis` is as near to the truth as that bias |
| training | of `full_geometry`, not counted in the ratios |
| paid after | images of 2 % noise after which the training has paid |
| a dash | lost in the noise of the truth |

Russian roulette only adds variance. A setting of `volpathmis` with seemingly less variance than one of later roulette
has not met its rare bright paths yet, and counts with the variance of the other. `volpathmis` renders the channels of
a medium one by one if their mean cosines differ. `full_geometry` draws two entries an exit, and one under an even
sky."""
BARE_NOTES = """\
The models without surface reflection and without the single scattering that they lack, against `volpathmis` at its
best setting and at rr_depth 200."""


def equal_error(scenes: Mapping[tuple[str, str], Params]) -> pandas.DataFrame:
    """A row for each scene and method.

    Args:
        scenes: (material, lights) -> what `benchmarks.equal_error.measured` gave.
    """
    import pandas

    return pandas.DataFrame([row for scene, each in scenes.items() for row in _scene_rows(scene, each)])


def _scene_rows(scene: tuple[str, str], values: Params) -> list[Row]:
    costs = _costs(values["rows"])
    best = min((name for name in VOLUMES if costs.get(name, 0.0) > 0), key=lambda name: costs[name], default=None)
    best_cost, level, rows = costs.get(best, np.nan), values["truth"]["mean square"], []
    for row in values["rows"]:
        name, bias2, error = row["method"], _certain(row, "bias2"), _certain(row, "error")
        if "," in name:  # it leaves out on purpose what the truth has
            bias2 = error = np.nan
        rows.append(
            {
                "material": scene[0],
                "lights": scene[1],
                **row,
                "cost": costs[name],
                "relative bias": np.sqrt(bias2 / level),
                "ratio": _ratio(best_cost, costs[name]),
                "ratio with bias": _ratio(best_cost, error * row["seconds"]),
                "ratio to rr_depth 200": _ratio(costs.get(LATE_ROULETTE, np.nan), costs[name]),
                "seconds until bias": _ratio(best_cost, bias2),
                "is best volpathmis": name == best,
                "seconds of training": values.get("training", {}).get(name, np.nan),
                "images until paid": _until_paid(name, values, costs[name], best_cost),
            }
        )
    return rows


def _until_paid(name: str, values: Params, cost: float, best: float) -> float:
    """Images of noise `WANTED` after which training and renders took less time than `volpathmis`; NaN if never."""
    training = values.get("training", {}).get(name, np.nan)
    saved = (best - cost) / (WANTED**2 * values["truth"]["mean square"])
    return float(np.ceil(training / saved)) if saved > 0 and np.isfinite(training) else np.nan


def _costs(rows: Sequence[Params]) -> dict[str, float]:
    """Variance times seconds by method; of volpathmis no variance is below that of a later roulette."""
    of_a_sample, results = {row["method"]: row["variance"] * row["spp"] for row in rows}, {}
    for row in rows:
        name = row["method"]
        later = VOLUMES[VOLUMES.index(name) :] if name in VOLUMES else (name,)
        variance = max(of_a_sample[other] for other in later if other in of_a_sample) / row["spp"]
        results[name] = variance * row["seconds"] if variance > 0 else np.nan
    return results


def _certain(row: Params, key: str) -> float:
    """A number of a row, NaN where the noise of the truth hides it."""
    return row[key] if row[key] > CERTAIN * row[f"{key} standard error"] else np.nan


def _ratio(above: float, below: float) -> float:
    return above / below if below > 0 else np.nan


def sampling(rows: Sequence[Params]) -> pandas.DataFrame:
    """Seconds per million samples, with their sum."""
    import pandas

    table = pandas.DataFrame(rows)
    table["sum"] = table.drop(columns="model").sum(axis=1)
    return table


def furnace(numbers: Mapping[str, Mapping[str, float]]) -> pandas.DataFrame:
    """Mean radiance by method, with its excess over 1."""
    import pandas

    rows = [{"method": name, **each, "excess": each["mean"] - 1} for name, each in numbers.items()]
    return pandas.DataFrame(rows)


def markdown(errors: pandas.DataFrame, sampling: pandas.DataFrame, furnace: pandas.DataFrame) -> str:
    """All three as one text."""
    whole = errors[~errors["method"].str.contains(", ")]
    bare = errors[errors["method"].str.contains(", ")]
    parts = ["# Time to equal error", NOTES, _whole(whole)]
    if len(bare):
        parts += ["## Without reflection and single scattering", BARE_NOTES, _bare(bare)]
    steps = sampling.assign(model=[look(name).label for name in sampling["model"]])
    parts += [
        "## Seconds per million samples",
        "Each step as a kernel of its own; S of three channels.",
        in_markdown(steps),
    ]
    names = [label(name) if name == WALK else look(name).label for name in furnace["method"]]
    parts += ["## White furnace", "Mean radiance; 1 is right.", _furnace(furnace, names)]
    return "\n\n".join(parts) + "\n"


def _whole(rows: pandas.DataFrame) -> str:
    kept = rows[~rows["method"].isin(VOLUMES) | rows["is best volpathmis"]]
    table = kept[["material", "lights"]].assign(
        method=[label(name) for name in kept["method"]],
        variance=kept["ratio"],
        **{
            "with bias": kept["ratio with bias"],
            "bias": [_percent(*pair) for pair in zip(kept["method"], kept["relative bias"])],
        },
        **{"until, s": kept["seconds until bias"], "training, s": kept["seconds of training"]},
        **{"paid after": kept["images until paid"]},
    )
    return in_markdown(table)


def _percent(method: str, share: float) -> str:
    if method in (WALK, *VOLUMES):
        return "none"
    return f"{100 * share:.2g} %" if np.isfinite(share) else "—"


def _bare(rows: pandas.DataFrame) -> str:
    table = rows[["material", "lights"]].assign(
        model=[label(name.partition(", ")[0]) for name in rows["method"]],
        **{"to the best": rows["ratio"], "to rr_depth 200": rows["ratio to rr_depth 200"]},
    )
    return in_markdown(table)


def _furnace(rows: pandas.DataFrame, names: Sequence[str]) -> str:
    table = rows[[]].assign(
        method=names,
        mean=[f"{m:.4f} ± {e:.4f}" for m, e in zip(rows["mean"], rows["standard error"])],
        excess=[f"{v:+.4f}" for v in rows["excess"]],
    )
    return in_markdown(table)
