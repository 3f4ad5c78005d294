"""Where the time of a sample of the BSSRDF goes: finding the entry, looking for light there, and evaluating S."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from figures.computing.contenders import contender
from figures.computing.scenes import prepare
from figures.parts.part import Task
from halfspace_sss.backend import kernel_seconds

__all__ = ["split"]

STEPS = ("entries", "visibility", "evaluation")


def split(task: Task) -> dict[str, Any]:
    """Seconds per million samples of each step and model, each step as a kernel of its own over the same lanes.

    The models take turns; of the repeats the fastest counts, which is the one that nothing else delayed.
    """
    prepare()
    p = task.params
    steps = {model: _steps(contender(model, p["material"], 64, "small light"), p["lanes"]) for model in p["models"]}
    best = {(model, step): np.inf for model in p["models"] for step in STEPS}
    for k in range(p["repeats"] + 1):  # the first compiles
        for model, step in best:
            seconds = kernel_seconds(steps[model][step])
            best[model, step] = min(best[model, step], seconds) if k else np.inf
        task.progress(k + 1, p["repeats"] + 1)
    scale = 1e6 / p["lanes"]
    return {
        "rows": [{"model": model, **{step: scale * best[model, step] for step in STEPS}} for model in p["models"]],
        "lanes": p["lanes"],
    }


def _steps(scene: Any, n: int) -> dict[str, Callable[[], Any]]:
    """For each step what it computes, from inputs that are in memory."""
    import drjit as dr
    import mitsuba as mi

    from halfspace_sss.rendering.object.points import cosine_above, place
    from halfspace_sss.rendering.paths.path_loop import exit_at

    (body,) = scene.integrator().prepare(scene)
    si, sampler = _seen(scene, n), mi.load_dict({"type": "independent"})
    sampler.seed(11, n)
    out, face = exit_at(body, si), mi.UInt32(si.prim_index)
    prepared = body.transport.prepare(out, mi.Bool(True))
    where = body.proposals.prepare(out, prepared, mi.Bool(True))
    entry = body.proposals.sample(out, face, where, sampler, mi.Bool(True))
    direction, _ = cosine_above(entry.n_out, entry.n_face, sampler.next_2d())  # the same for all models
    dr.eval(tuple(out), face, tuple(entry), direction, sampler)  # named tuples are passed over
    ray = place(entry.p, entry.n).spawn_ray(direction)
    dr.eval(ray)
    found = entry.weight > 0
    dr.eval(found)

    def evaluated() -> Any:
        return body.transport.S_mu(prepared, entry, direction, found)

    return {
        "entries": lambda: tuple(body.proposals.sample(out, face, where, sampler.clone(), mi.Bool(True))),
        "visibility": lambda: scene.ray_intersect_preliminary(ray, coherent=False, active=found),
        "evaluation": evaluated,
    }


def _seen(scene: Any, n: int) -> Any:
    """Points of the object where n rays of the camera meet it."""
    import drjit as dr
    import mitsuba as mi

    rng, sensor, found = np.random.default_rng(5), scene.sensors()[0], np.zeros((2, 0), dtype=np.float32)
    while found.shape[1] < n:
        place = rng.random((2, 2 * n)).astype(np.float32)
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(place), mi.Point2f(0.5))
        found = np.hstack([found, place[:, np.array(scene.ray_intersect_preliminary(ray).is_valid())]])
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(found[:, :n]), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    dr.eval(si)
    return si
