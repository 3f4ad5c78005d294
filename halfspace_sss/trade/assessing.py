"""How wrong and how dear each way of rendering a scene is, measured on its own lights, camera and objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from halfspace_sss.checks import check_count, check_interval, renamed
from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED
from halfspace_sss.trade.images import with_flip
from halfspace_sss.trade.measuring.objects import EXITS, assess_stage
from halfspace_sss.trade.measuring.results import Assessment
from halfspace_sss.trade.measuring.ways import Way, stage, ways
from halfspace_sss.trade.refining import assess_for

__all__ = ["assess"]


def assess(
    scene: Any,
    *,
    seconds: float = 4.0,
    models: Sequence[str] | None = None,
    sensor: int = 0,
    seed: int = 0,
    flip: bool = True,
    tolerance: float | None = None,
    exits: int = EXITS,
    parameters: dict[str, str] | None = None,
    progress: NamedProgress | None = None,
    only: Sequence[str] | None = None,
) -> Assessment:
    """Measure each way of rendering a scene on each of its translucent objects.

    At points of an object that the camera sees, radiance by each way is compared with that by random walks, with the
    noise of both taken out; time is that of the same samples. Lights, reflections and other objects are those of the
    scene, at its own largest depth.

    Args:
        scene: a Mitsuba scene, a dict as for `mitsuba.load_dict`, or the path of an XML file.
        seconds: for each object, shared by all ways; compilation comes on top, and a little for many ways.
        models: names of ways, such as "neural", by default all; "path_traced" is always among them.
        sensor: number of the sensor.
        seed: of everything; what depends on the clock is how many samples are taken.
        flip: whether to render small images for FLIP, if the evaluator is installed.
        tolerance: of a job; more than half of the time is then for ways that might be the cheapest to keep it.
        exits: points of each object.
        parameters: values of the parameters $name of an XML file.
        progress: called with (what, done, total).
        only: what `models` was called before.

    Left out: what lies behind glass or in mirrors, the mirror images of lamps on the objects, and the errors of fine
    detail between the points.

    Raises:
        ValueError: an argument is out of range, or the scene cannot be rendered.
    """
    check_interval("seconds", seconds, 0.05, 1e5)
    check_count("seed", seed, 0)
    check_count("exits", exits, 32)
    if tolerance is not None:
        check_interval("tolerance", tolerance, 1e-4, 10.0)
    chosen = _chosen(renamed(models, only, "models", "only"))
    on = stage(scene, parameters)
    check_count("sensor", sensor, 0)
    if sensor >= len(on.scene.sensors()):
        raise ValueError(f"sensor must be below {len(on.scene.sensors())}, the number of sensors, got {sensor}")
    how = {"seconds": seconds, "sensor": sensor, "seed": seed, "exits": exits, "progress": progress}
    if tolerance is None:
        found = assess_stage(on, chosen, **how)
    else:
        found = assess_for(on, chosen, tolerance, **how)
    if flip:
        found = with_flip(on, chosen, found, sensor, seed)
    return found


def _chosen(models: Sequence[str] | None) -> list[Way]:
    if models is None:
        return ways()
    chosen = [Way.of(name) for name in models]
    return [Way(PATH_TRACED), *(way for way in dict.fromkeys(chosen) if way.model != PATH_TRACED)]
