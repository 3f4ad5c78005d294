"""Fig. 10: S along a line for four angles of incidence, path traced and by every model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from figures.computing.learnt import accepting, weight_files
from figures.parts.part import Params, Part, Result, Task
from halfspace_sss.comparison.curve_set import Curve, CurveSet, render
from halfspace_sss.comparison.reflectance_curves import FIG10_THETA_I, curves
from halfspace_sss.materials import load
from halfspace_sss.physics.medium import Medium

TITLE = "S over distance, path traced and by every model"
WALKS = {"draft": 4_000_000, "paper": 64_000_000}  # for each angle of incidence


def parts(quality: str) -> list[Part]:
    """The path-traced curve of each angle, then the curves of each model that accepts the medium."""
    walks = WALKS[quality]
    traced = [
        Part(_traced_name(theta), traced_curves, {"theta_i_deg": theta, "n_paths": walks, "seed": seed}, work=walks)
        for seed, theta in enumerate(FIG10_THETA_I)
    ]
    medium = load("fig10").medium
    angles = list(FIG10_THETA_I)
    return traced + [
        Part(name, model_curves, {"model": name, "theta_i_deg": angles}, len(angles), inputs=weight_files(name, medium))
        for name in accepting(medium)
    ]


def traced_curves(task: Task) -> dict[str, object]:
    """The path-traced curve of one angle."""
    p = task.params
    result = curves(
        "fig10", theta_i_deg=[p["theta_i_deg"]], models=[], n_paths=p["n_paths"], seed=p["seed"],
        progress=task.progress,
    )  # fmt: skip
    return _as_numbers(result)


def model_curves(task: Task) -> dict[str, object]:
    """The curves of one model for all angles."""
    name, angles = task.params["model"], task.params["theta_i_deg"]
    return _as_numbers(curves("fig10", theta_i_deg=angles, models=[name], n_paths=0, progress=task.progress))


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the values and the errors as tables."""
    result = curve_set(results)
    files: dict[str, bytes | str] = {f"fig10.{ending}": data for ending, data in render(result).items()}
    return files | result.tables("fig10")


def curve_set(results: Mapping[str, Result]) -> CurveSet:
    """One set of curves from those of the parts, for each angle the path-traced one first."""
    numbers = {name: result.numbers for name, result in results.items()}
    traced = [numbers[_traced_name(theta)] for theta in FIG10_THETA_I]
    common = dict(traced[0]["common"])
    medium, r_edges = Medium(**common.pop("medium")), np.array(common.pop("r_edges"))
    outcome = [_as_curve(c) for part in numbers.values() for c in part["curves"]]
    ordered = tuple(sorted(outcome, key=lambda c: FIG10_THETA_I.index(c.theta_i_deg)))  # stable: parts keep their order
    speeds = {name: speed for part in numbers.values() for name, speed in part["evaluations_per_s"].items()}
    seconds = sum(part["seconds"] for part in traced)
    return CurveSet(**common, medium=medium, r_edges=r_edges, curves=ordered, evaluations_per_s=speeds, seconds=seconds)


def _traced_name(theta_i_deg: float) -> str:
    return f"path traced, {theta_i_deg:g} degrees"


def _as_numbers(result: CurveSet) -> dict[str, object]:
    """What `curve_set` needs, ready for JSON."""
    plain = ("title", "theta_o_deg", "delta_phi_deg", "line_deg", "half_width", "orders", "n_paths", "seed", "backend")
    common = {name: getattr(result, name) for name in plain}
    common["medium"] = {name: float(getattr(result.medium, name)) for name in ("sigma_s", "sigma_a", "g", "eta")}
    common["r_edges"] = result.r_edges.tolist()
    return {
        "common": common,
        "curves": [
            {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in dataclasses.asdict(c).items()}
            for c in result.curves
        ],
        "evaluations_per_s": dict(result.evaluations_per_s),
        "seconds": result.seconds,
    }


def _as_curve(values: Params) -> Curve:
    arrays = {name: np.array(values[name]) for name in ("S", "S_at_r", "standard_error")}
    reflectance = {order: tuple(each) for order, each in values["reflectance"].items()}
    return Curve(**{**values, **arrays, "reflectance": reflectance})
