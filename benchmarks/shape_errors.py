"""Errors of the network of all shapes on objects that it was not trained on: tables, and pictures of the worst."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.held_out import HELD_OUT
from benchmarks.shape_training import draw_object
from figures.parts.part import SceneDict
from full_geometry.learning.model_errors import LIGHTS, RadianceError, errors_of, transport_of
from full_geometry.objects.objects import TranslucentObject, object_of
from full_geometry.transport.any_shape import transport
from full_geometry.transport.descriptors import mean_chord
from halfspace_sss.materials import load as load_material
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.registry import bssrdf
from halfspace_sss.tracing.walk import generator, pass_seed

# ----------------------------------------------------------------------------------------------------
# Errors of the network of all shapes on held-out shapes and media, a mesh, spheres; and what an evaluation costs.


HALF_SPACES = ("neural", "better_dipole", "directional_dipole")
EXITS, WALKS, SAMPLES = 128, 4096, 4096
DARK, MORE = 0.5, 12  # reduced albedo below which most walks end inside, and how many more there are
RADII = (1.0, 3.0, 10.0, 30.0)  # mean free paths
LANES = 2**18
HELD_OUT_SEED = 77


@dataclass(frozen=True, eq=False)
class Case:
    """An object to be evaluated.

    Args:
        name: of shape and medium.
        obj: the object.
    """

    name: str
    object: TranslucentObject


@dataclass(frozen=True)
class Row:
    """One channel of a case: what it is, and (error, standard error) under constant light and under lobes by model."""

    name: str
    size: float
    albedo: float
    g: float
    eta: float
    thickness: float
    errors: Mapping[str, Mapping[str, tuple[float, float]]]

    def of(self, model: str, light: str = "constant") -> float:
        """Error of a model."""
        return self.errors[model][light][0]

    def best(self, light: str = "constant") -> tuple[str, float]:
        """The best half-space model and its error."""
        name = min((m for m in self.errors if m != "neural_shape"), key=lambda m: self.of(m, light))
        return name, self.of(name, light)


def held_out(n: int) -> Iterator[Case]:
    """Objects of the families that were not trained on, each family in turn; media and sizes as in training."""
    families = tuple(HELD_OUT)
    for k in range(n):
        family = families[k % len(families)]
        yield Case(family, draw_object((HELD_OUT_SEED, 10**6 + k), {family: HELD_OUT[family]}).object)


def of_mesh(path: str | Path, materials: Sequence[str], mm_per_unit: float) -> Iterator[Case]:
    """A mesh of each channel of materials of the registry."""
    for material in materials:
        medium = load_material(material).medium
        for k, channel in enumerate("RGB"):
            shape = mi.load_dict({"type": "ply", "filename": str(path)})
            yield Case(f"{material} {channel}", object_of(shape, medium.channel(k), mm_per_unit))


def spheres(albedo: float = 0.95, eta: float = 1.3) -> Iterator[Case]:
    """Spheres of 1, 3, 10 and 30 mean free paths."""
    for radius in RADII:
        shape = mi.load_dict({"type": "sphere", "radius": radius})
        yield Case(f"sphere of {radius:g} mfp", object_of(shape, Medium(albedo, 1 - albedo, 0.0, eta)))


def evaluate(
    cases: Iterator[Case], n: int, *, seed: int = 0, progress: NamedProgress | None = None, path: Path | None = None
) -> list[Row]:
    """The errors of the network and of the half-space models.

    Args:
        cases: objects, of one channel each.
        n: how many there are.
        seed: of exits, walks and entries.
        progress: called with (what, done, total).
        path: of other weights.
    """
    rows = []
    for k, case in enumerate(cases):
        if progress:
            progress(case.name, k, n)
        obj = case.object
        models: dict[str, object] = {"neural_shape": transport(obj, path)}
        models |= {name: transport_of(obj, name) for name in HALF_SPACES if _takes(name, obj)}
        walks = WALKS * (MORE if float(obj.media[0].albedo_prime) < DARK else 1)
        errors = errors_of(obj, models, exits=EXITS, walks=walks, samples=SAMPLES, seed=seed)
        rows.append(_row(case, errors))
    return rows


def _takes(name: str, obj: TranslucentObject) -> bool:
    """Whether a half-space model takes the medium and has its orders two and more."""
    try:
        return bssrdf(name, obj.media[0]).orders == "multiple"
    except ValueError:
        return False


def _row(case: Case, by_model: Mapping[str, list[RadianceError]]) -> Row:
    m = case.object.media[0]
    errors = {
        model: {light: next((r.error, r.standard_error) for r in rows if r.light == light and r.channel == 0)
                for light in LIGHTS}
        for model, rows in by_model.items()
    }  # fmt: skip
    size = float(case.object.mean_free_paths()[0])
    thickness = mean_chord(case.object) * float(m.sigma_t)
    return Row(case.name, size, float(m.albedo), float(m.g), m.eta, thickness, errors)


def seconds_per_million(obj: TranslucentObject, path: Path | None = None) -> dict[str, float]:
    """Seconds for a million evaluations, entry and exit prepared anew, of the network and of half-space models."""
    models: dict[str, object] = {"neural_shape": transport(obj, path)}
    models |= {name: transport_of(obj, name) for name in HALF_SPACES}
    rng = generator(mi, LANES, pass_seed(29))
    exits, entries = obj.random_points(rng), obj.random_points(rng)
    dr.eval(tuple(exits), tuple(entries))  # named tuples are passed over
    seconds = {}
    for name, model in models.items():
        times = []
        for _ in range(3):  # the first one compiles
            dr.sync_thread()
            at = time.perf_counter()
            dr.eval(model.S(model.prepare(exits), entries))
            dr.sync_thread()
            times.append(time.perf_counter() - at)
        seconds[name] = 1e6 / LANES * min(times[1:])
    return seconds


# ---- Tables of errors as text of Markdown ----------------------------------------------------------

MODEL = "neural_shape"
BINS: dict[str, tuple[Callable[[Row], float], tuple[float, ...]]] = {
    "sigma_t sqrt(A)": (lambda r: r.size, (1, 10, 100, 3000)),
    "mean chord, mfp": (lambda r: r.thickness, (0, 1, 5, 30, 1e9)),
    "reduced albedo": (lambda r: r.albedo * (1 - r.g) / (1 - r.albedo * r.g), (0, 0.5, 0.9, 0.99, 1.001)),
    "g": (lambda r: r.g, (-1, -0.01, 0.01, 0.5, 1)),
}


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines) + "\n"


def _percent(pair: tuple[float, float]) -> str:
    return f"{100 * pair[0]:.1f} ± {100 * pair[1]:.1f}"


def case_table(rows: Sequence[Row]) -> str:
    """Every case: what it is, the best half-space model under constant light, and both errors of the network, %."""
    head = ["object", "size, mfp", "albedo", "g", "eta", "half-space", "its error", "its lobes", "constant", "lobes"]
    cells = []
    for r in rows:
        name, _ = r.best()
        cells.append([
            r.name, f"{r.size:.3g}", f"{r.albedo:.4g}", f"{r.g:.2g}", f"{r.eta:.3g}", name,
            *(_percent(r.errors[model][light]) for model in (name, MODEL) for light in LIGHTS),
        ])  # fmt: skip
    return _table(head, cells)


def summary(rows: Sequence[Row]) -> str:
    """Median and 90th percentile of the errors, and how they compare with the best half-space model of each case, %."""
    cells = []
    for light in LIGHTS:
        own = np.array([r.of(MODEL, light) for r in rows])
        best = np.array([r.best(light)[1] for r in rows])
        ratio = best / np.maximum(own, 1e-9)
        cells.append([
            light, f"{100 * np.median(own):.1f}", f"{100 * np.quantile(own, 0.9):.1f}",
            f"{100 * np.median(best):.1f}", f"{100 * np.quantile(best, 0.9):.1f}", f"{np.median(ratio):.1f}",
            f"{(ratio >= 4).sum()} of {len(rows)}", f"{(ratio < 1).sum()} of {len(rows)}",
        ])  # fmt: skip
    head = ["light", "median", "90th percentile", "best half-space: median", "90th percentile", "median ratio",
            "4 times better", "worse"]  # fmt: skip
    return _table(head, cells)


def by_property(rows: Sequence[Row]) -> str:
    """Median errors under constant light by size, thickness, albedo and g, %."""
    results = []
    for name, (value, edges) in BINS.items():
        for low, high in zip(edges, edges[1:]):
            inside = [r for r in rows if low <= value(r) < high]
            if inside:
                own, best = ([f(r) for r in inside] for f in (lambda r: r.of(MODEL), lambda r: r.best()[1]))
                to = "" if high > 1e8 else f" to {high:g}"
                cells = (f"{100 * np.median(own):.1f}", f"{100 * max(own):.1f}", f"{100 * np.median(best):.1f}")
                results.append([name, f"{low:g}{to}", str(len(inside)), *cells])
    return _table(["by", "range", "objects", "median", "largest", "best half-space: median"], results)


def speed_table(seconds: dict[str, float]) -> str:
    """Seconds per million evaluations."""
    return _table(["model", "seconds per million"], [[name, f"{v:.2f}"] for name, v in seconds.items()])


WORST = 10
SIZE, SPP, WALKED_SPP, GAP = 96, 64, 256, 4
DISTANCE, FOV = 4.0, 28.0  # of the camera, radii of the object
BRIGHT = 97  # percentile of the path-traced object that is shown white


def worst_pictures(rows: Sequence[Row], progress: NamedProgress | None = None) -> np.ndarray:
    """The objects with the largest errors under constant light: a row of three images for each, worst first.

    All scattering orders, half a sky from the left; each row exposed by its path-traced image.

    Args:
        rows: the errors of `cases.held_out(len(rows))`, in order.
        progress: called with (what, done, total).

    Returns:
        Radiance (height, width), 1 where it is white.
    """
    worst = sorted(range(len(rows)), key=lambda k: -rows[k].of("neural_shape"))[:WORST]
    objects = {k: case for k, case in enumerate(held_out(max(worst) + 1)) if k in worst}
    lines = []
    for done, k in enumerate(worst):
        if progress:
            progress("pictures", done, len(worst))
        models = ("path_traced", "neural_shape", rows[k].best()[0])
        images = [picture(objects[k], model) for model in models]
        lit = images[0][images[0] > 0]
        white = float(np.percentile(lit, BRIGHT)) if lit.size else 1.0
        lines.append(
            np.concatenate([np.pad(np.minimum(v / white, 1), GAP // 2, constant_values=1) for v in images], axis=1)
        )
    return np.concatenate(lines)


def picture(case: Case, model: str, size: int = SIZE) -> np.ndarray:
    """Radiance (size, size) of an object by a model, or "path_traced", under half a sky from the left."""
    from full_geometry.scenes.scene_files import load_scene

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes: they are what is shown
        scene = load_scene(_scene(case, Path(folder) / "object.ply", size), model)
        image = mi.render(scene, spp=WALKED_SPP if model == "path_traced" else SPP, seed=1)
    return np.maximum(np.array(image, dtype=float).reshape(size, size, -1).mean(axis=2), 0)


def _scene(case: Case, path: Path, size: int) -> SceneDict:
    shape, m = case.object.geometry.shape, case.object.media[0]
    shape.write_ply(str(path))
    box = shape.bbox()
    centre, radius = np.array(box.center()).ravel(), 0.5 * float(np.linalg.norm(np.array(box.extents()).ravel()))
    eye = centre + DISTANCE * radius * np.array([0.25, 0.3, 0.92])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance", "rfilter": {"type": "box"}}
    pixels = np.zeros((16, 32, 3), np.float32)
    pixels[:, :16] = 1
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "hide_emitters": True},
        "sensor": {
            "type": "perspective", "fov": FOV,
            "to_world": mi.ScalarTransform4f().look_at(list(eye), list(centre), [0, 1, 0]),
            "film": film,
        },
        "light": {"type": "envmap", "bitmap": mi.Bitmap(pixels)},
        "object": {
            "type": "ply", "filename": str(path),
            "bsdf": {
                "type": "translucent", "model": "neural", "sigma_s": float(m.sigma_s), "sigma_a": float(m.sigma_a),
                "g": float(m.g), "eta": m.eta,
            },
        },
    }  # fmt: skip
