"""The model "auto": the cheapest one of each object whose bias keeps the tolerance of the integrator, by measurement.

All models that are installed are candidates. Costs are variance of a sample times seconds. If no model keeps the
tolerance the least biased is taken. The choice is kept in a file, so that the same scene gets the same model again; the
file can be deleted, and a model that is named in the scene needs no choice. The integrator cannot mix walks with
models, and says where walks would be the better way.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from halfspace_sss.neural.trained import weights_folder
from halfspace_sss.provenance import provenance, write_atomically
from halfspace_sss.rendering.object.registry import AUTO, model_names
from halfspace_sss.rendering.scenes.identity import scene_hash
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED
from halfspace_sss.trade.assessing import assess_stage
from halfspace_sss.trade.results import ObjectTrade, WayTrade
from halfspace_sss.trade.ways import Stage, Way

__all__ = ["ENVIRONMENT_VARIABLE", "choices_folder", "choose", "picked"]

ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_CHOICES"
DEFAULT = "neural"
EXITS = 96  # of each object
SAMPLES = (64, 2048)  # fewest and most of each exit by each way; the fewest take some tenths of a second
FORMAT = "halfspace-sss choice 1"


def choices_folder() -> Path:
    """Folder of the choices: HALFSPACE_SSS_CHOICES, or beside the weights of the user."""
    stated = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(stated) if stated else weights_folder().parent / "choices"


def choose(scene: Any, settings: Any) -> None:
    """Give every surface of a scene whose model is "auto" the one that its objects are best rendered by, for good.

    Args:
        scene: the Mitsuba scene, whose surfaces change.
        settings: `Settings` of the integrator; the tolerance is theirs, and the share of the samples of an image that
            the choice takes, as far as `SAMPLES` allows.

    Raises:
        ValueError: the scene cannot be rendered, or the file of an earlier choice is damaged.
    """
    import mitsuba as mi

    on = _stage(scene, settings)
    wanted = [k for k, shape in enumerate(on.shapes) if shape.bsdf().inside.model == AUTO]
    path = choices_folder() / f"{_identity(on, settings)}.json"
    record = _read(path) if path.is_file() else None
    if record is None or len(record["models"]) != len(wanted):
        record = _measured(on, wanted, settings)
        write_atomically(path, json.dumps(record, indent=1, allow_nan=False) + "\n")
    given: dict[int, str] = {}
    for k, model, sentence in zip(wanted, record["models"], record["sentences"]):
        surface = on.shapes[k].bsdf()
        if id(surface) in given:  # objects of one surface take the model of the first
            continue
        given[id(surface)] = model
        surface.inside, surface.choice = replace(surface.inside, model=model), sentence
        mi.Log(mi.LogLevel.Info, sentence)


def _stage(scene: Any, settings: Any) -> Stage:
    from halfspace_sss.rendering.object.placement import translucent_shapes

    return Stage(scene, translucent_shapes(scene), settings.shared(), settings.of_models())


def _identity(on: Stage, settings: Any) -> str:
    import mitsuba as mi

    plugin = {"type": "bssrdf", **on.settings, **on.bssrdf, "tolerance": settings.tolerance}
    plugin |= {"choice_share": settings.choice_share}
    return scene_hash(on.scene, mi.load_dict(plugin))[:32]


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        models = [str(name) for name in record["models"]]
        known = (
            len(models) == len(record["sentences"])
            and record["format"] == FORMAT
            and all(name in model_names() and name != AUTO for name in models)
        )
        sentences = [str(s) for s in record["sentences"]]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} must be the record of a choice, got {error!r}; delete it to choose anew") from error
    if not known:
        raise ValueError(f"{path} must name models that are installed, got {models}; delete it to choose anew")
    return {**record, "models": models, "sentences": sentences}


def _measured(on: Stage, wanted: list[int], settings: Any) -> dict[str, Any]:
    ways = [Way(name) for name in (PATH_TRACED, *model_names()) if name != AUTO]
    samples = _samples(on, settings.choice_share / len(ways))
    found = assess_stage(on, ways, samples=samples, exits=EXITS)
    models, sentences = zip(*(picked(found.objects[k], settings.tolerance) for k in wanted))
    about = provenance(tolerance=settings.tolerance, samples=samples, exits=EXITS)
    record = {"format": FORMAT, "models": list(models), "sentences": list(sentences)}
    return {**record, "assessment": found.record(), "provenance": about}


def _samples(on: Stage, share: float) -> int:
    """Of each exit by each way, which take that share of the samples of the first sensor's image."""
    if not on.scene.sensors():
        return SAMPLES[0]
    camera = on.scene.sensors()[0]
    image = math.prod(int(n) for n in camera.film().crop_size()) * camera.sampler().sample_count()
    return min(max(int(share * image / (EXITS * len(on.shapes))), SAMPLES[0]), SAMPLES[1])


def picked(found: ObjectTrade, tolerance: float) -> tuple[str, str]:
    """The model for an object, and one sentence."""
    rows = [row for row in found.ways if not row.refusal and row.way in model_names()]
    if not rows or found.is_dark:
        return _default(rows), f"object {found.object!r}: {_default(rows)}, as nothing is seen that could be compared"
    keeping = [row for row in rows if row.bias_bound <= tolerance]
    if keeping:
        best = min(keeping, key=_cost)
        why = f"{best.told_bias} % off, asked {100 * tolerance:.3g} %"
    else:
        best = min(rows, key=lambda row: (row.bias_bound, _cost(row)))
        why = f"the least wrong, {best.told_bias} % off"
        why += f"; no model is known to keep {100 * tolerance:.3g} %"
    walks = not keeping or _cost(found.traced) < _cost(best)
    if walks:
        why += "; translucent_walk would be better"
        why += " and faster" if _cost(found.traced) < _cost(best) else ", which has no bias"
    return best.way, f"object {found.object!r}: {best.way}, {why}"


def _default(rows: list[WayTrade]) -> str:
    names = [row.way for row in rows]
    return DEFAULT if DEFAULT in names or not names else names[0]


def _cost(row: WayTrade) -> float:
    """Seconds until the noise is that of one: compared between ways."""
    return row.time_to(1.0) if row.variance >= 0 else math.inf
