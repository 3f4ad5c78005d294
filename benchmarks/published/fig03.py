"""Fig. 3: points of entry of one exit by the paper's flow, without and with light, and by learnt patches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.modelling.learnt import object_parts
from figures.computing.scans import BUNNY, prepare, scan_scene
from figures.parts.part import Params, Part, Result, Task
from halfspace_sss.comparison.style import TEXT, paper, saved
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    import mitsuba as mi
    from matplotlib.axes import Axes

    from full_geometry.geometry.points import SurfacePoint
    from full_geometry.objects.objects import TranslucentObject
    from full_geometry.transport.features import ObjectFrame
    from full_geometry.transport.storing import Learnt

SHAPES = ("bunny", "candle")
TITLE = "points of entry drawn by the paper's flow, without and with light, and by patches"
SECONDS = {"draft": 6, "paper": 60}  # CPU time of the object, and of each flow
POINTS = {"draft": 512, "paper": 2048}
RESOLUTION = {"draft": 64, "paper": 192}  # of the candle
SHOWN = ("uniform", "flow", "flow with light", "patches")
PLACES, DOTS = 40_000, 6000  # of the surface, and those behind the points
TOWARDS = {"bunny": (0.1, 0.25, 1.0), "candle": (0.1, 0.8, 1.0)}  # where the eye stands, and near what the exit lies


def parts(quality: str) -> list[Part]:
    """The points of each object."""
    seconds = SECONDS[quality]
    common = {"seconds": seconds, "points": POINTS[quality], "resolution": RESOLUTION[quality], "seed": 0}
    return [
        Part(name, sampled, {"object": name, "towards": list(TOWARDS[name]), **common}, seconds, inputs=(BUNNY,))
        for name in SHAPES
    ]


def sampled(task: Task) -> dict[str, object]:
    """Points in the object's frame over its radius, their RMSD to the nearest barycentre, and light where they are."""
    from benchmarks.published.paper_flow import fit_space_flow, mesh_arrays, on_surface, rmsd
    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of
    from full_geometry.transport.storing import frame_of

    prepare()
    p, n = task.params, task.params["points"]
    scene = _lit(p["object"], task, p["resolution"], p["seed"])
    obj = object_of(scene)
    learnt = train_unattended(obj, task.folder, cpu_seconds=p["seconds"], seed=p["seed"])
    task.progress(1, 4)
    frame = frame_of(obj)
    vertices, faces = mesh_arrays(obj, frame)
    exit = _exit(obj, p["towards"])
    results = {"uniform": _positions(frame, obj.random_points(_lanes(n, 41)).p)}
    for k, (name, light) in enumerate((("flow", None), ("flow with light", scene)), 2):
        flow = fit_space_flow(learnt.model, frame, p["seconds"], p["seed"], light)
        in_space = flow.sample(exit, n, p["seed"])[0]
        results |= {f"{name}, in space": in_space, name: on_surface(in_space, vertices, faces, p["seed"])}
        task.progress(k, 4)
    results["patches"] = _positions(frame, _by_patches(learnt, exit, n))
    places, E = _light(obj, scene, frame)
    return {
        "points": {name: np.round(results[name], 5).tolist() for name in SHOWN},
        "rmsd": {name: rmsd(points, vertices, faces) for name, points in results.items()},
        "light": {name: _light_at(points, places, E) for name, points in results.items()},
        "mesh": np.round(places[:DOTS], 4).tolist(),
        "E": np.round(E[:DOTS] / E.max(), 4).tolist(),
        "exit": _positions(frame, exit.p)[0].tolist(),
        "seconds": p["seconds"],
    }


def _lit(name: str, task: Task, resolution: int, seed: int) -> mi.Scene:
    """The candle with its flame, or the bunny with a small light behind."""
    from full_geometry.scenes.scene_files import open_scene

    if name == "candle":
        shown = object_parts("candle", resolution, check_folder(task.folder), seed)
        return open_scene({"type": "scene", "integrator": {"type": "bssrdf"}, **shown}, "neural")
    return open_scene(scan_scene("potato", 16, "small light"), "neural")


def _light(obj: TranslucentObject, scene: mi.Scene, frame: ObjectFrame) -> tuple[np.ndarray, np.ndarray]:
    """Random places of the surface, and the light that arrives there."""
    from benchmarks.published.paper_flow import irradiance

    at = obj.random_places(_lanes(PLACES, 43))
    return _positions(frame, at.p), irradiance(at, scene, (44,))


def _light_at(points: np.ndarray, places: np.ndarray, E: np.ndarray) -> float:
    """Mean light at points, by the nearest place of each, over that of the surface."""
    from scipy.spatial import cKDTree

    return float(E[cKDTree(places).query(points)[1]].mean() / E.mean())


def _lanes(n: int, seed: int) -> mi.PCG32:
    import mitsuba as mi

    from halfspace_sss.tracing.walk import generator, pass_seed

    return generator(mi, n, pass_seed(seed))


def _exit(obj: TranslucentObject, towards: list[float]) -> SurfacePoint:
    """The point of the surface that lies farthest towards the eye among those that face it, seen along its normal."""
    import drjit as dr
    import mitsuba as mi

    points = obj.random_points(_lanes(4096, 40))
    eye = np.array(towards) / np.linalg.norm(towards)
    faces_it = eye @ np.array(points.n) > 0.8
    k = int(np.argmax(np.where(faces_it, eye @ np.array(points.p), -np.inf)))
    at = points.gather(dr.full(mi.UInt32, k, 1))
    return at._replace(w=mi.Vector3f(at.n_out))


def _by_patches(learnt: Learnt, exit: SurfacePoint, n: int) -> mi.Point3f:
    import drjit as dr
    import mitsuba as mi

    from full_geometry.transport.features import Side, first_event

    rng = _lanes(n, 42)
    at = exit.gather(dr.zeros(mi.UInt32, n))
    weights = learnt.sampler.prepare(Side(at, first_event(learnt.model.object, at)))
    u = (rng.next_float32(), rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
    return learnt.sampler.sample(weights, *u)[0].p


def _positions(frame: ObjectFrame, p: mi.Point3f) -> np.ndarray:
    return np.array(frame.position(p), dtype=float).T


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, and distances and light as a table."""
    import pandas
    from matplotlib.figure import Figure

    with paper():
        figure = Figure(figsize=(TEXT, 0.31 * TEXT * len(results)))
        axes = figure.subplots(len(results), len(SHOWN), squeeze=False)
        for row, (name, result) in zip(axes, results.items()):
            for ax, kind in zip(row, SHOWN):
                _draw_points(ax, result.numbers, kind, TOWARDS[name])
                ax.set_title(f"{kind}\nlight at points {result.numbers['light'][kind]:.2f}")
            row[0].set_ylabel(name)
        figure.tight_layout(pad=0.3)
        files: dict[str, bytes | str] = {f"fig03.{end}": data for end, data in saved(figure).items()}
    rows = [
        {
            "object": name,
            "points": kind,
            "rmsd over the radius": value,
            "light over the mean": result.numbers["light"][kind],
            "CPU seconds": result.numbers["seconds"],
        }
        for name, result in results.items()
        for kind, value in result.numbers["rmsd"].items()
    ]
    files["fig03.csv"] = pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    return files


def _draw_points(ax: Axes, numbers: Params, kind: str, towards: tuple[float, float, float]) -> None:
    """The surface, brighter where light arrives, points as the eye sees them, those on the far side paler, the exit."""
    eye = np.array(towards) / np.linalg.norm(towards)
    right = np.cross([0, 1, 0], eye)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(eye, right), eye])
    mesh, points, exit = (np.array(v) @ axes.T for v in (numbers["mesh"], numbers["points"][kind], [numbers["exit"]]))
    order = np.argsort(mesh[:, 2])  # the near side covers the far one
    E = np.sqrt(np.array(numbers["E"]))[order]
    ax.scatter(*mesh[order].T[:2], s=1.5, c=E, cmap="YlOrBr", vmin=-0.15, vmax=1.3, linewidths=0, rasterized=True)
    ax.scatter(*points.T[:2], s=3, c="#0072B2", alpha=0.6, linewidths=0, rasterized=True)
    ax.scatter(*exit.T[:2], s=30, c="#D55E00", marker="*", linewidths=0, zorder=5)
    low, high = mesh.min(axis=0), mesh.max(axis=0)
    ax.set(xlim=(low[0] - 0.1, high[0] + 0.1), ylim=(low[1] - 0.1, high[1] + 0.1), aspect="equal", xticks=[], yticks=[])
    for side in ax.spines.values():
        side.set_visible(False)
