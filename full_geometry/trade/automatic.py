"""The model "auto": the cheapest one of each object whose bias keeps the tolerance of the integrator, by measurement.

All models that are installed are candidates, with light as the integrator states it: "sampled" by default, "gathered",
or "auto" for the cheaper of both. Costs are seconds of an image, preparation counted. Where the few samples of a choice
do not tell whether a model keeps the tolerance, the least biased is taken; where none does, `bssrdf` refuses the scene.
The command `render` takes walks, with precomputed or sampled light, where they are the cheapest way that `recommend`
finds. Inside `bssrdf`, which cannot walk, a sentence says so. Choices are kept in files, so that the same scene gets
the same again; they can be deleted, and a model that is named in the scene needs no choice.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi

from full_geometry.geometry.snapshot import scene_hash
from full_geometry.objects.objects import refuse_instances, translucent_shapes
from full_geometry.settings import AUTO, PATH_TRACED, Choices, Settings
from full_geometry.surface.wrapped import surface_of
from full_geometry.trade.advice import Advice, advise
from full_geometry.trade.assessing import CANDIDATES, DOUBT, assess_for, assess_stage
from full_geometry.trade.results import ObjectTrade, TechniqueTrade
from full_geometry.trade.techniques import (
    CORRECTED,
    GATHERED,
    LAMBERT,
    WALKS,
    Effort,
    Job,
    Stage,
    Technique,
)
from full_geometry.transport.models import model_names
from halfspace_sss.neural.store import weights_folder
from halfspace_sss.provenance import provenance, write_atomically

ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_CHOICES"
DEFAULT = "neural"
EXITS = 96  # of each object
SAMPLES = (64, 2048)  # fewest and most of each exit by each way; the fewest take some tenths of a second
FORMAT = "halfspace-sss choice 3"


def choices_folder() -> Path:
    """Folder of the choices: HALFSPACE_SSS_CHOICES, or beside the weights of the user."""
    stated = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(stated) if stated else weights_folder().parent / "choices"


def choose(scene: mi.Scene, settings: Settings) -> Choices:
    """The model that every object whose model is "auto" is best rendered by, and the light if that is "auto".

    Args:
        scene: the Mitsuba scene.
        settings: of the integrator; the tolerance is theirs, and the share of the samples of an image that the choice
            takes, as far as `SAMPLES` allows.

    Raises:
        ValueError: the scene cannot be rendered, models are known not to keep the tolerance, or the file of an earlier
            choice is damaged.
    """
    on, named = _stage(scene, settings), models_of(scene, settings)
    path = choices_folder() / f"{_identity(on, settings)}.json"
    record = _read(path) if path.is_file() else None
    if record is None or len(record["models"]) != len(named):
        record = _measured(on, named, settings)
        write_atomically(path, json.dumps(record, indent=1, allow_nan=False) + "\n")
    for sentence in record["sentences"]:
        mi.Log(mi.LogLevel.Info, sentence)
    models = {k: model for k, model in enumerate(record["models"]) if named[k] == AUTO}
    if record["refusal"]:
        raise ValueError(record["refusal"])
    return Choices(models, record["light"], dict(zip(on.names, record["sentences"])))


def models_of(scene: mi.Scene, settings: Settings) -> list[str]:
    """What the integrator or the surfaces of a scene name as the model of each translucent object."""
    return [settings.model or surface_of(shape).spec.model for shape in translucent_shapes(scene)]


def _stage(scene: mi.Scene, settings: Settings) -> Stage:
    """The scene as techniques are measured on it; ValueError if instances show an object."""
    shapes = translucent_shapes(scene)
    refuse_instances(scene, shapes, "the model 'auto'")
    return Stage(scene, shapes, settings.shared(), settings.of_models())


def _identity(on: Stage, settings: Settings) -> str:
    plugin = {"type": "bssrdf", **on.settings, **on.bssrdf, "tolerance": settings.tolerance}
    plugin |= {name: getattr(settings, name) for name in ("choice_share", "light", "model", "orders")}
    return scene_hash(on.scene, mi.load_dict(plugin))[:32]


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        models, sentences = ([str(name) for name in record[key]] for key in ("models", "sentences"))
        known = record["format"] == FORMAT and all(name in model_names() and name != AUTO for name in models)
        known &= record["light"] in ("sampled", GATHERED, CORRECTED) and len(models) == len(sentences)
        known &= isinstance(record["refusal"], str)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} must be the record of a choice, got {error!r}; delete it to choose anew") from error
    if not known:
        raise ValueError(f"{path} must name models that are installed, got {models}; delete it to choose anew")
    return {**record, "models": models, "sentences": sentences}


def _measured(on: Stage, named: list[str], settings: Settings) -> dict[str, Any]:
    lights = ("sampled", GATHERED) if settings.light == AUTO else (settings.light,)
    models = _known() if AUTO in named else dict.fromkeys(named)
    techniques = [WALKS]
    techniques += [_way(name, light) for name in models for light in lights if _has(name, light)]
    samples = _samples(on, settings.choice_share / len(techniques))
    result = assess_stage(on, techniques, Effort(samples=samples, exits=EXITS))
    picks = {light: [picked(o, settings.tolerance, light, name) for o, name in zip(result.objects, named)]
             for light in lights}  # fmt: skip
    light = min(lights, key=lambda light: _total(picks[light]))
    about = provenance(tolerance=settings.tolerance, samples=samples, exits=EXITS)
    record = {"format": FORMAT, "light": light, "models": [pick.model for pick in picks[light]]}
    record |= {"sentences": [pick.sentence for pick in picks[light]]}
    off = [pick.sentence for pick, name in zip(picks[light], named) if name == AUTO and pick.is_wrong]
    refusal = f"a model must keep the tolerance {settings.tolerance:g}, or be named: {'; '.join(off)}" if off else ""
    record["refusal"] = refusal
    return {**record, "assessment": result.record(), "provenance": about}


def _known() -> list[str]:
    """Models that "auto" chooses among; walks have no share in it."""
    return [name for name in model_names() if name != AUTO]


def _has(model: str, light: str) -> bool:
    """Whether a way exists: a diffuse surface gathers nothing, and is the same in both kinds of light."""
    return model != LAMBERT or light == "sampled"


def _way(model: str, light: str) -> Technique:
    return Technique(model, light=light if _has(model, light) else "sampled")


def _samples(on: Stage, share: float) -> int:
    """Samples of each exit by each technique that take this share of the samples of the first sensor's image."""
    if not on.scene.sensors():
        return SAMPLES[0]
    camera = on.scene.sensors()[0]
    image = math.prod(int(n) for n in camera.film().crop_size()) * camera.sampler().sample_count()
    return min(max(int(share * image / (EXITS * len(on.shapes))), SAMPLES[0]), SAMPLES[1])


class Pick(NamedTuple):
    """A model for an object.

    Args:
        model: its name.
        seconds: of an image by it; infinite if it is not known to keep the tolerance.
        sentence: why.
        is_wrong: whether it is known not to keep the tolerance.
    """

    model: str
    seconds: float
    sentence: str
    is_wrong: bool = False


def _total(picks: list[Pick]) -> float:
    return sum(pick.seconds for pick in picks)


def picked(assessed: ObjectTrade, tolerance: float, light: str = "sampled", model: str = AUTO) -> Pick:
    """The model for an object among those of one kind of light, or what can be said of the one that is named."""
    names = _known() if model == AUTO else (model,)
    techniques = {_way(name, light).name: name for name in names}
    rows = [row for row in assessed.ways if not row.refusal and row.way in techniques]
    if not rows or assessed.is_dark:
        name = _default([techniques[row.way] for row in rows] or list(techniques.values()))
        why = f"object {assessed.object!r}: {name}, as the camera sees nothing to compare"
        return Pick(name, 0.0 if rows else math.inf, why)
    keeping = [row for row in rows if row.bias_bound <= tolerance]
    if keeping:
        best = min(keeping, key=lambda row: _cost(assessed, row, tolerance))
        why = f"{best.told_bias} % off, the tolerance is {100 * tolerance:.3g} %"
    else:
        best = min(rows, key=lambda row: (row.bias_bound, _cost(assessed, row, tolerance)))
        why = f"the least wrong, {best.told_bias} % off"
        why += f"; no model is known to keep {100 * tolerance:.3g} %"
    cost, walks = _cost(assessed, best, tolerance), _cost(assessed, assessed.traced, tolerance)
    if not keeping or walks < cost:
        why += "; translucent_walk would be better"
        why += " and faster" if walks < cost else ", which has no bias"
    seconds, why = cost if keeping else math.inf, f"object {assessed.object!r}: {best.way}, {why}"
    return Pick(techniques[best.way], seconds, why, not _may_keep(best, tolerance))


def walks_instead(scene: mi.Scene, settings: Settings) -> tuple[str, str]:
    """The light of walks that are cheaper than models for all objects, and why; "" and "" where models are.

    It is decided as `recommend` does, for one image, and kept in a file beside the choices of models.

    Args:
        scene: the Mitsuba scene, all of whose objects have the model "auto".
        settings: of its integrator.

    Raises:
        ValueError: the scene cannot be rendered, or the file is damaged.
    """
    on = _stage(scene, settings)
    path = choices_folder() / f"{_identity(on, settings)}_walks.json"
    if path.is_file():
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            return str(record["light"]), str(record["why"])
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} must be the record of a choice, got {error!r}; delete it") from error
    lights = ("sampled", GATHERED) if settings.light == AUTO else ("sampled", settings.light)
    job, candidates = Job(settings.tolerance), map(Technique.of, CANDIDATES)
    chosen = [each for each in candidates if each.walks or each.light in lights]
    light, why = walks_of(advise(assess_for(on, chosen, job, Effort()), job))
    record = {"light": light, "why": why, "provenance": provenance(tolerance=settings.tolerance)}
    write_atomically(path, json.dumps(record, indent=1) + "\n")
    return light, why


def walks_of(advice: Advice) -> tuple[str, str]:
    """The light of the walks that are advised for all objects, and why; "" and "" where models are advised."""
    if all(each.is_dark or not each.ways for each in advice.assessment.objects):
        return "", ""
    asked, some = f"{100 * advice.tolerance:.3g} %", advice.seconds < math.inf
    if not some:
        return "sampled", f"{PATH_TRACED}, light sampled, as nothing is known to keep {asked}"
    if not advice.integrator.startswith(PATH_TRACED):
        return "", ""
    light = Technique.of(advice.integrator).light
    return light, f"{PATH_TRACED}, light {light}, is the cheapest that keeps {asked}: {advice.seconds:.2g} s an image"


def _may_keep(row: TechniqueTrade, tolerance: float) -> bool:
    return row.bias2 - DOUBT * row.bias2_error <= tolerance**2


def _default(names: list[str]) -> str:
    return DEFAULT if DEFAULT in names or not names else names[0]


def _cost(assessed: ObjectTrade, row: TechniqueTrade, tolerance: float) -> float:
    """Seconds of an image until its noise is at the tolerance."""
    return row.preparation + assessed.pixels * row.time_to(tolerance) if row.variance >= 0 else math.inf
