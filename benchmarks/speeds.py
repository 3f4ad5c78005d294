"""Speed of models over Mitsuba's volume path tracer or our walk: sampled and gathered.

A cost is the variance of a sample over mean squared, times its CPU seconds. Both are means over blocks of 8 x 8
pixels, of which the median is taken. Where chance finds a lamp once in hundreds of samples, most pixels have not met it
yet, and a median over pixels leaves it out. A speed is the cost of `volpathmis` at its best roulette depth, or of the
walk, over that of a way.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from benchmarks.hand_and_ribbon import SHAPES, STANDING
from benchmarks.methods import ready, volume
from benchmarks.modelling.learnt import object_parts
from benchmarks.modelling.meshes import surface
from benchmarks.modelling.objects import MODELS as VARYING
from benchmarks.modelling.objects import tissue
from benchmarks.published import meat  # noqa: F401  # an object more
from benchmarks.published.fig01 import VIEWS
from benchmarks.timed import TimedRender, alternating, rendered
from figures.computing.contenders import WALK
from figures.computing.scans import SCANS, prepare, scan_scene, surroundings
from figures.parts.part import Row, SceneDict
from full_geometry.trade.denoising import cover
from halfspace_sss import materials
from halfspace_sss.neural.store import weights_in
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import provenance, write_atomically

if TYPE_CHECKING:
    import pandas

LIGHTS = ("windows", "lamp and sky")
ALL_LIGHTS = (*LIGHTS, "even sky", "small light", "sun and sky")
MODELS = ("full_geometry", "neural_shape", "neural", "better_dipole")
KINDS = ("sampled", "gathered")
OVER = ("volpathmis", WALK)
VOLUMES = tuple(volume(depth) for depth in (64, 200))
SPP = {"volume": 4, WALK: 16, "model": 16}  # of a pass
BLOCK, LEAST = 8, 16  # pixels of its side; of those that it must have
PASSES = 6
RESOLUTION = 64  # of modelled objects
ACROSS = 30.0  # mean free paths, of shapes that any material fills
EYE, FAR, FOV = (0.35, 0.2, 1.0), 3.5, 34.0  # of these: direction, distance in their sizes / 2, degrees
# of a lamp: from the middle of the object and radius, in sizes of it, and radiance
LAMP = (0.5, 0.8, 0.6), 0.09, (60.0, 57.0, 52.0)
SMALL = (-0.9, 0.62, -0.6), 0.1, (90.0, 84.0, 75.0)  # behind it, as that of scans
DIM = (0.4, 0.45, 0.5)
SUN = (0.5, 0.6, 0.8)  # towards it
FLOOR = 2.0  # half its side, in sizes of what stands on it
FRAME, NOISE, IMAGE = 256, 0.01, 512  # pixels of the next frame; noise of an image of so many pixels
FORMAT = "halfspace-sss speeds 1"


@dataclass(frozen=True)
class LitObject:
    """An object in a light; ValueError if there is none of that name.

    Args:
        name: "SCAN of MATERIAL", "SHAPE of MATERIAL", "candle" or an object whose medium varies.
        light: of `ALL_LIGHTS`.
    """

    name: str
    light: str

    def __post_init__(self) -> None:
        shape, of, _ = self.name.partition(" of ")
        if not (shape in (*SCANS, *SHAPES) if of else shape in VIEWS):
            known = [*(f"{name} of MATERIAL" for name in (*SCANS, *SHAPES)), *VIEWS]
            raise ValueError(f"object must be one of {', '.join(known)}, got {self.name!r}")
        _ = self.medium

    @property
    def key(self) -> str:
        """Id of its shape."""
        return self.name.split()[0]

    @property
    def slug(self) -> str:
        """For names of files."""
        return f"{self.name}, {self.light}".replace(", ", "-").replace(" ", "_")

    @property
    def medium(self) -> Medium:
        """Of a medium that varies any with its mean cosine."""
        _, of, material = self.name.partition(" of ")
        return materials.load(material).medium if of else tissue("candle wax").medium

    def description(self, size: int, folder: Path) -> SceneDict:
        """The scene as a dict, `size` pixels wide."""
        _, of, material = self.name.partition(" of ")
        if self.key in SCANS:
            found = scan_scene(material, size, "small light" if self.light == "small light" else "even sky", self.key)
        elif of:
            found = self._shape(size, folder)
        else:
            view = VIEWS[self.name]
            to_world = mi.ScalarTransform4f().look_at(list(view.origin), list(view.target), [0, 1, 0])
            film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
            shown = object_parts(self.name, RESOLUTION, folder)
            found = {
                "type": "scene",
                "integrator": {"type": "bssrdf", "hide_emitters": True},
                "sensor": {"type": "perspective", "fov": view.fov, "to_world": to_world, "film": film},
                self.name: shown[self.name],
            }
        if self.light == "even sky":
            found["sky"] = {"type": "constant", "radiance": 1.0}
        elif self.light == "windows":
            found["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(surroundings())}
        elif self.light == "sun and sky":
            upright = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
            found["sky"] = {"type": "sunsky", "sun_direction": list(SUN), "to_world": upright}
        elif self.light == "lamp and sky":
            found["lamp"] = self._lamp(found, *LAMP)
            found["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": list(DIM)}}
        elif "lamp" not in found:
            found["lamp"] = self._lamp(found, *SMALL)
        return found

    def _lamp(self, found: SceneDict, towards: Sequence[float], radius: float, glow: Sequence[float]) -> SceneDict:
        box = mi.load_dict({k: v for k, v in found[self.key].items() if k != "bsdf"}).bbox()
        across = float(np.linalg.norm(np.array(box.extents())))
        centre = (np.ravel(np.array(box.center())) + across * np.array(towards)).tolist()
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(glow)}}
        return {"type": "sphere", "center": centre, "radius": radius * across, "emitter": emitter}

    def _shape(self, size: int, folder: Path) -> SceneDict:
        """A shape of `ACROSS` mean free paths."""
        path = folder / f"{self.key}.ply"
        if not path.is_file():
            surface(*SHAPES[self.key](), RESOLUTION).write_ply(path)
        material = self.name.partition(" of ")[2]
        shown = {"type": "ply", "filename": str(path)}
        box = mi.load_dict(shown).bbox()
        centre, across = np.ravel(np.array(box.center())), float(np.linalg.norm(np.array(box.extents())))
        eye = centre + 0.5 * FAR * across * np.array(EYE) / np.linalg.norm(EYE)
        to_world = mi.ScalarTransform4f().look_at(eye.tolist(), centre.tolist(), [0, 1, 0])
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
        mm_per_unit = ACROSS / float(np.median(self.medium.sigma_t)) / across
        floor = {}
        if self.key in STANDING:
            # half a thousandth below what stands there: faces that coincide hide each other by chance
            low = centre - (0, 0.5 * float(np.array(box.extents())[1]) + 5e-4 * across, 0)
            flat = mi.ScalarTransform4f().translate(low.tolist()).rotate([1, 0, 0], -90).scale(FLOOR * across)
            grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}
            floor = {"floor": {"type": "rectangle", "to_world": flat, "bsdf": grey}}
        return {
            "type": "scene",
            "integrator": {"type": "bssrdf", "mm_per_unit": mm_per_unit, "hide_emitters": True},
            "sensor": {"type": "perspective", "fov": FOV, "to_world": to_world, "film": film},
            self.key: {**shown, "bsdf": {"type": "translucent", "material": material}},
            **floor,
        }


@dataclass(frozen=True)
class Measuring:
    """How speeds are measured.

    Args:
        models: of `MODELS`.
        kinds: of their light, of `KINDS`.
        size: pixels of the square images.
        passes: of `SPP` samples, at least 3.
        over: what counts as one, of `OVER`.
        frames: whether the next frames of gathered light are timed.
        seconds: CPU time of a training of `full_geometry`.
        seed: of all renders.
    """

    models: tuple[str, ...] = MODELS
    kinds: tuple[str, ...] = KINDS
    size: int = 96
    passes: int = PASSES
    over: str = OVER[0]
    frames: bool = True
    seconds: float = 24.0
    seed: int = 0


def ways_of(case: LitObject, how: Measuring) -> list[str]:
    """What counts as one, the walk, and models with the kinds of light that they take."""
    varies = case.key in VARYING
    kinds = [kind for kind in how.kinds if not (varies and kind != KINDS[0])]
    models = [model for model in how.models if not (varies and model == "neural_shape")]
    volumes = VOLUMES if how.over == OVER[0] else ()
    return [*volumes, WALK, *(f"{model}, {kind}" for model in models for kind in kinds)]


def scene_of(case: LitObject, way: str, size: int, folder: Path, **settings: float | str) -> mi.Scene:
    """The Mitsuba scene of a way, or three, with further settings of the integrator."""
    model, _, kind = way.partition(", ")
    found = case.description(size, folder)
    found["integrator"] |= settings
    if kind:
        found["integrator"]["light"] = kind
    return ready(model, found, case.key, case.medium)


def train(case: LitObject, seconds: float, folder: Path) -> float:
    """Learn the object, unless it has been; the CPU seconds that took."""

    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of
    from full_geometry.scenes.scene_files import open_scene
    from full_geometry.transport.storing import KIND, find_weights

    scene = open_scene(case.description(16, folder), KIND)
    learnt = object_of(scene, None, None, case.key)
    with weights_in(folder):
        try:
            find_weights(learnt)
            return 0.0
        except ValueError:
            started = time.process_time()
            train_unattended(learnt, folder, cpu_seconds=seconds)
            return time.process_time() - started


def speeds(
    cases: Sequence[LitObject], how: Measuring, folder: Path, progress: Callable[[str, int, int], None]
) -> pandas.DataFrame:
    """A row for each case and way; cases that the folder holds are not measured again.

    Args:
        cases: objects in their light.
        how: they are measured.
        folder: for weights, meshes and rows.
        progress: called with what, done and all.
    """
    import pandas

    prepare()
    rows = []
    for k, case in enumerate(cases):
        progress(f"{case.name}, {case.light}", k, len(cases))
        kept = folder / f"{case.slug}.json"
        key = json.loads(json.dumps({"format": FORMAT, **asdict(case), **asdict(how)}))
        record = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else {}
        if record.get("key") != key:
            training = train(case, how.seconds, folder) if "full_geometry" in how.models else 0.0
            with weights_in(folder):
                record = {"key": key, "rows": _measured(case, how, folder, training)}
            write_atomically(kept, json.dumps({**record, "provenance": provenance(**key)}) + "\n")
        rows += record["rows"]
    return pandas.DataFrame(rows)


def _measured(case: LitObject, how: Measuring, folder: Path, training: float) -> list[Row]:
    scenes, ready_after, spp = {}, {}, {}
    for way in ways_of(case, how):
        spp[way] = SPP["volume" if way in VOLUMES else WALK if way == WALK else "model"]
        scenes[way] = scene_of(case, way, how.size, folder)
        rendered(scenes[way], spp[way], how.seed)
        ready_after[way] = sum(scenes[way].integrator().gathering.seconds) if "gathered" in way else 0.0
    covered = cover(scenes[WALK]) > 0.999
    found = alternating(scenes, spp, how.seed + 1, passes=how.passes)
    noise = {way: _noise(timed, covered) for way, timed in found.items()}
    seconds = {
        way: float(np.median(timed.pass_cpu_seconds)) / spp[way] for way, timed in found.items()
    }  # of a sample of all pixels
    best = min(noise[way][0] * seconds[way] for way in (VOLUMES if how.over == OVER[0] else (WALK,)))
    rows = []
    for way, (variance, error) in noise.items():
        speed, timed = best / (variance * seconds[way]), how.frames and way.endswith("gathered")
        light, camera = _next_frames(scenes[way], case, folder) if timed else (np.nan, np.nan)
        samples = max(variance / NOISE**2, 1.0)
        rows.append(
            {
                "object": case.name, "light": case.light, "way": way, "speed": speed, "standard error": speed * error,
                "ready after, s": ready_after[way],
                "to 1 %, s": ready_after[way] + samples * seconds[way] * (IMAGE / how.size) ** 2,
                "light changed, s": light, "camera moved, s": camera,
                "training, s": training if way.startswith("full_geometry") else 0.0,
            }
        )  # fmt: skip
    return rows


def _noise(timed: TimedRender, covered: np.ndarray) -> tuple[float, float]:
    """The variance of a sample over the mean squared, median over blocks and channels, and its relative error.

    The error is that of passes: the spread of the medians without each of them in turn.
    """
    n = len(timed.images)
    blocks = np.stack(np.indices(covered.shape) // BLOCK)
    number = np.where(covered, blocks[0] * (covered.shape[1] // BLOCK + 1) + blocks[1], -1)
    kept = [number == k for k in np.unique(number[covered]) if (number == k).sum() >= LEAST]
    if not kept:
        raise ValueError(f"size must be larger: no block has {LEAST} pixels inside the object, got {len(covered)}")

    def typical(images: np.ndarray) -> float:
        variance, mean = images.var(axis=0, ddof=1, dtype=np.float64), images.mean(axis=0, dtype=np.float64)
        whole = [(variance[block].mean(axis=0), mean[block].mean(axis=0)) for block in kept]
        return float(np.median([timed.spp // n * v / np.maximum(m, 1e-30) ** 2 for v, m in whole]))

    value = typical(timed.images)
    without = [typical(np.delete(timed.images, k, axis=0)) for k in range(n)]
    return max(value, 1e-30), float(np.std(without) * np.sqrt(n - 1) / max(value, 1e-30))


def _next_frames(scene: mi.Scene, case: LitObject, folder: Path) -> tuple[float, float]:
    """CPU seconds of the next frame of one sample a pixel, once the light or the camera has changed."""
    sensor = mi.load_dict(case.description(FRAME, folder)["sensor"])
    lights, views = mi.traverse(scene), mi.traverse(sensor)
    light = next(k for k in lights.keys() if k.startswith(("sky", "lamp")) and k.endswith(("data", "radiance.value")))

    def brighter() -> None:
        lights[light] = lights[light] * 1.1
        lights.update()

    def nearer() -> None:
        views["to_world"] = views["to_world"] @ mi.Transform4f().translate([0, 0, 0.01])
        views.update()

    found = []
    for change in (brighter, nearer):
        took = []
        for seed in range(3):
            started = time.process_time()
            change()
            np.array(mi.render(scene, sensor=sensor, spp=1, seed=seed))
            took.append(time.process_time() - started)
        found.append(min(took[1:]))  # the first compiles
    return found[0], found[1]


def tables(table: pandas.DataFrame) -> tuple[pandas.DataFrame, pandas.DataFrame]:
    """Speeds with a column for each object and light, and what gathered light takes."""
    table = table.assign(
        case=table["object"] + ", " + table["light"],
        text=[f"{a:.2g} ± {b:.1g}" for a, b in zip(table["speed"], table["standard error"])],
    )
    cases, ways = (list(dict.fromkeys(table[key])) for key in ("case", "way"))
    wide = table.pivot(index="way", columns="case", values="text").loc[ways, cases].fillna("–")
    wide["median"] = [f"{v:.2g}" for v in table.groupby("way")["speed"].median().loc[ways]]
    gathered = table[table["way"].str.endswith("gathered") & table["camera moved, s"].notna()]
    columns = ["case", "way", "ready after, s", "to 1 %, s", "light changed, s", "camera moved, s"]
    return wide.reset_index(), gathered[columns]
