"""The cheapest way of rendering a scene that keeps a tolerance, by measurement: "auto", and `render` without a model.

All ways of `assessing.CANDIDATES` may be taken: walks with sampled or precomputed light, denoised too, and models with
sampled, gathered or corrected light. A way keeps a tolerance if its bias² and what is left of its noise are within it,
with the doubt of their measurement. Where none is known to, `render` walks until the noise is within it.
The integrator `bssrdf`, which cannot walk, chooses among models for each object whose model is "auto", with light as it
states it or, where that is "auto", the cheapest; it refuses a scene in which no model is known to keep the tolerance.
What was measured is kept in files, so that the same scene gets the same way again; they can be deleted.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi

from full_geometry.geometry.snapshot import scene_hash
from full_geometry.objects.objects import refuse_instances, translucent_shapes
from full_geometry.settings import AUTO, GATHERED_LIGHTS, PATH_TRACED, Choices, Settings
from full_geometry.surface.wrapped import surface_of
from full_geometry.trade.advice import Advice, advise
from full_geometry.trade.assessing import CANDIDATES, assess_for
from full_geometry.trade.results import Assessment, ObjectTrade
from full_geometry.trade.techniques import (
    CORRECTED,
    LAMBERT,
    PRECOMPUTED_WALKS,
    READY_FIRST,
    WALKED,
    WALKS,
    Effort,
    Job,
    Stage,
    Technique,
)
from halfspace_sss.neural.store import weights_folder
from halfspace_sss.provenance import provenance, write_atomically

ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_CHOICES"
DEFAULT = "neural"
UNNAMED = (*(way.name for way in WALKED), f"{READY_FIRST}, {CORRECTED}")  # where nothing names a model
FORMAT = "halfspace-sss choice 6"


def choices_folder() -> Path:
    """Folder of what was measured: HALFSPACE_SSS_CHOICES, or beside the weights of the user."""
    stated = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(stated) if stated else weights_folder().parent / "choices"


def choose(scene: mi.Scene, settings: Settings) -> Choices:
    """The model that every object whose model is "auto" is best rendered by, and the light if that is "auto".

    Args:
        scene: the Mitsuba scene.
        settings: of the integrator; the tolerance is theirs.

    Raises:
        ValueError: the scene cannot be rendered, no model is known to keep the tolerance, or the file of what was
            measured is damaged.
    """
    named = models_of(scene, settings)
    found = _measured(scene, settings, ways_of(named, settings.light)).objects
    picks = {
        light: [picked(o, settings.tolerance, light, name) for o, name in zip(found, named)]
        for light in _lights(settings.light)
    }
    light = min(picks, key=lambda light: sum(pick.seconds for pick in picks[light]))
    for pick in picks[light]:
        mi.Log(mi.LogLevel.Info, pick.sentence)
    off = [pick.sentence for pick, name in zip(picks[light], named) if name == AUTO and not pick.keeps]
    if off:
        asked = f"a model must be known to keep the tolerance {settings.tolerance:g}, or be named"
        raise ValueError(f"{asked}; translucent_walk and `render --model auto` keep it: {'; '.join(off)}")
    models = {k: pick.model for k, pick in enumerate(picks[light]) if named[k] == AUTO}
    return Choices(models, light, {o.object: pick.sentence for o, pick in zip(found, picks[light])})


def models_of(scene: mi.Scene, settings: Settings) -> list[str]:
    """What the integrator or the surfaces of a scene name as the model of each translucent object."""
    return [settings.model or surface_of(shape).spec.model for shape in translucent_shapes(scene)]


def ways_of(named: Sequence[str], light: str) -> list[str]:
    """Names of the techniques that are measured: of the candidates, or of models that are named."""
    lights = _lights(light)
    if AUTO in named:
        known = {name: Technique.of(name) for name in CANDIDATES}
        return [name for name, way in known.items() if way.walks or way.light in lights or way.model == LAMBERT]
    ways = [WALKS, PRECOMPUTED_WALKS, *(_way(name, light) for name in named for light in lights)]
    return list(dict.fromkeys(way.name for way in ways))


def _lights(light: str) -> tuple[str, ...]:
    return ("sampled", *GATHERED_LIGHTS) if light == AUTO else (light,)


def _measured(scene: mi.Scene, settings: Settings, ways: Sequence[str]) -> Assessment:
    """What was measured of a scene for the tolerance, now or before."""
    shapes = translucent_shapes(scene)
    refuse_instances(scene, shapes, "the model 'auto'")
    on = Stage(scene, shapes, settings.shared(), settings.of_models())
    plugin = {"type": "bssrdf", **on.settings, **on.bssrdf, "tolerance": settings.tolerance}
    identity = hashlib.sha256(", ".join([scene_hash(scene, mi.load_dict(plugin)), *ways]).encode()).hexdigest()
    path = choices_folder() / f"{identity[:32]}.json"
    if path.is_file():
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if record["format"] != FORMAT:
                raise ValueError(record["format"])
            return Assessment.from_record(record["assessment"])
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path} must be the record of a choice, got {error!r}; delete it to choose anew"
            ) from error
    found = assess_for(on, [Technique.of(way) for way in ways], Job(settings.tolerance), Effort())
    about = {"format": FORMAT, "assessment": found.record(), "provenance": provenance(tolerance=settings.tolerance)}
    write_atomically(path, json.dumps(about, indent=1, allow_nan=False) + "\n")
    return found


def _way(model: str, light: str) -> Technique:
    """A model; a diffuse surface gathers nothing, and is the same in sampled and gathered light."""
    return Technique(model, light="sampled" if model == LAMBERT else light)


class Pick(NamedTuple):
    """A model for an object.
    `seconds`: of an image by it; infinite if it is not known to keep the tolerance. `sentence`: why. `keeps`: whether
    it is known to keep the tolerance."""

    model: str
    seconds: float
    sentence: str
    keeps: bool = True


def picked(assessed: ObjectTrade, tolerance: float, light: str = "sampled", model: str = AUTO) -> Pick:
    """The model for an object among those of one kind of light, or what can be said of the one that is named."""
    known = {Technique.of(row.way): row for row in assessed.ways if not row.refusal}
    rows = {way.model: row for way, row in known.items() if way.serves(light) and model in (AUTO, way.model)}
    if not assessed.ways or assessed.is_dark:
        name = model if model != AUTO else DEFAULT if DEFAULT in rows or not rows else min(rows)
        why = f"object {assessed.object!r}: {name}, as the camera sees nothing to compare"
        return Pick(name, 0.0, why)
    if not rows:
        return Pick(model, math.inf, f"object {assessed.object!r}: no model takes it in {light} light", False)
    seconds = {name: assessed.job(row, tolerance)[0] for name, row in rows.items()}
    name = min(rows, key=lambda name: (seconds[name], rows[name].bias_bound))
    keeps, row = seconds[name] < math.inf, rows[name]
    if keeps:
        why = f"{row.told_bias} % off, the tolerance is {100 * tolerance:.3g} %"
    else:
        why = f"the least wrong, {row.told_bias} % off; no model is known to keep {100 * tolerance:.3g} %"
    walks = min(assessed.job(row, tolerance)[0] for row in assessed.ways if row.way.startswith(PATH_TRACED))
    if walks < seconds[name]:
        why += "; translucent_walk would be better" + (" and faster" if keeps else ", which has no bias")
    return Pick(name, seconds[name], f"object {assessed.object!r}: {row.way}, {why}", keeps)


# --------------------------------------------------------------------------------------------------
# The way of the command `render` for all objects of a scene.


class Decision(NamedTuple):
    """The way of all objects: that of walks, or None where models are chosen one by one; samples of a pixel, and why.
    No samples are known where nothing is known to keep the tolerance."""

    walks: Technique | None
    light: str
    spp: int | None
    why: str


def decided(scene: mi.Scene, settings: Settings, ways: Sequence[str]) -> Decision:
    """The cheapest of some ways for one image, as `recommend` finds it.
    `settings`: of the integrator; the tolerance is theirs. `ways`: names of techniques. ValueError if the scene cannot
    be rendered, or the file of what was measured is damaged."""
    return decision_of(advise(_measured(scene, settings, ways), Job(settings.tolerance)))


def decision_of(advice: Advice) -> Decision:
    """The way that is advised for all objects: walks where nothing is seen, or known to keep the tolerance."""
    asked = f"{100 * advice.tolerance:.3g} %"
    if not advice.seconds < math.inf or not any(o.way for o in advice.objects):
        return Decision(WALKS, "sampled", None, f"{WALKS.name}, light sampled, as nothing is known to keep {asked}")
    kind, _, light = advice.integrator.partition(", ")
    walks = Technique.of(advice.integrator) if kind == PATH_TRACED else None
    name = advice.integrator if walks or len(advice.objects) > 1 else advice.objects[0].way
    why = (
        f"{name}: the cheapest that keeps {asked}, an image in {advice.seconds:.2g} s with {advice.spp} samples a pixel"
    )
    return Decision(walks, (walks.light if walks else light) or "sampled", advice.spp, why)
