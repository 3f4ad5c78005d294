"""What renders cost under a variant of Mitsuba, on a CPU or a GPU: walks, a learnt object, live edits, first images.

Every function yields its rows one by one, as they are measured. Seconds are those of `backend.clock`: of all threads
over their number on a CPU, of the wall on a GPU.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.bench import REPEATS, Row
from full_geometry.cli.variants import use_mitsuba

# object and light: three shapes, three media
WALKED = (("hand of potato", "windows"), ("ribbon of cream", "lamp and sky"), ("bunny of marble", "windows"))
EDITED = "bunny of marble", "windows"
FIRST = ("better_dipole, gathered", "better_dipole, corrected", "walk", "full_geometry, gathered")
WALKS, LEARNT = "walk", "full_geometry, sampled"
SPP, LEARNT_SPP = 64, 16  # of an image
PASSES, TRAINING = 6, 10.0  # images of a way; seconds of a training
PATIENCE = 600.0  # seconds for a first image


def bench_renders(variant: str, size: int, training: float = 0.0, spp: int = SPP) -> Iterator[Row]:
    """Walks, or a learnt object, over Mitsuba's `volpathmis` at its better roulette depth, of 64 and 200.

    The cost of a way is the variance of a sample, summed over all pixels of the object, edges included, times its
    seconds. Each image precomputes its light inside; cells, which a scene makes once, are shared by 64 samples of a
    pixel. A row has nanoseconds a sample, seconds of cells, and the cost of `volpathmis` over that of the way.

    Args:
        variant: of Mitsuba.
        size: pixels of the square images.
        training: seconds that `full_geometry` learns each object, of which light is then sampled; 0 takes walks.
        spp: samples of a pixel in each of `PASSES` images, of a learnt object 16 at most.
    """
    use_mitsuba(variant)
    from benchmarks.lit_objects import VOLUMES, LitObject, scene_of, train
    from benchmarks.total_error import PRECOMPUTED, image_of_pass, lit_scene
    from full_geometry.trade.denoising import cover
    from halfspace_sss.backend import clock
    from halfspace_sss.neural.store import weights_in

    for case in (LitObject(*pair) for pair in WALKED):
        with TemporaryDirectory() as temporary:
            folder, costs, rows = Path(temporary), {}, []
            ways = (*VOLUMES, LEARNT if training else WALKS)
            if training:
                train(case, training, folder)

            def fresh(way: str, case: LitObject = case, folder: Path = folder) -> object:
                if way == LEARNT:
                    return scene_of(case, way, size, folder)
                return lit_scene(case, PRECOMPUTED if way == WALKS else way, size, folder)

            with weights_in(folder):
                for way in ways:
                    n, scene = min(spp, LEARNT_SPP) if way == LEARNT else spp, None
                    gc.collect()  # numbers of objects are in kernels: with no scene left both of the next have the same
                    image_of_pass(fresh(way), n, 1)  # compiles
                    gc.collect()
                    scene, images, took = fresh(way), [], []
                    for k in range(PASSES + 1):
                        started = clock()
                        images.append(image_of_pass(scene, n, 2 + k)[..., :3])
                        took.append(clock() - started)
                    inside = cover(scene if not isinstance(scene, tuple) else scene[0]) > 0
                    seconds = float(np.median(took[1:]))
                    cells = max(took[0] - seconds, 0.0) if way == WALKS else 0.0
                    variance = np.asarray(images[1:], dtype=np.float64)[:, inside].var(axis=0, ddof=1).sum() * n
                    costs[way] = variance * (seconds / n + cells / SPP)
                    rows.append(
                        {
                            "object": case.name, "light": case.light, "way": way,
                            "ns": 1e9 * seconds / (n * size**2), "cells_s": cells,
                            "mean": float(np.mean([image[inside].mean() for image in images])),
                        }
                    )  # fmt: skip
        best = min(costs[way] for way in VOLUMES)
        for row in rows:
            yield row | {"over_volpathmis": best / costs[row["way"]]}


def bench_edits(variant: str, size: int) -> Iterator[Row]:
    """Seconds of the first look after the light has turned and after the camera has moved, one sample a pixel.

    A row has a way, the seconds of the first image of a scene whose kernels are known, and of the next ones. Images are
    those of `view` in all pixels: of walks, with little light inside, or with that of the last camera.
    """
    use_mitsuba(variant)
    import mitsuba as mi

    from benchmarks.lit_objects import LitObject
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    case = LitObject(*EDITED)
    with TemporaryDirectory() as folder:
        for way in ("better_dipole, gathered", WALKS):
            model, _, light = way.partition(", ")

            def load(model: str = model, light: str = light) -> mi.Scene:
                found = case.description(size, Path(folder))
                return load_scene(
                    found, PATH_TRACED if model == WALKS else model, settings={"light": light} if light else {}
                )

            def turned(scene: mi.Scene) -> None:
                parameters = mi.traverse(scene)
                parameters["sky.to_world"] = parameters["sky.to_world"] @ mi.Transform4f().rotate([0, 1, 0], 10)
                parameters.update()

            def nearer(scene: mi.Scene) -> None:
                parameters = mi.traverse(scene.sensors()[0])
                parameters["to_world"] = parameters["to_world"] @ mi.Transform4f().translate([0, 0, 0.01])
                parameters.update()

            scene = load()
            for change in (_unchanged, turned, nearer, turned):
                _timed(scene, change)  # compiles
            scene = None
            gc.collect()
            started = time.perf_counter()
            scene = load()
            _timed(scene, _unchanged)
            row: Row = {"way": way, "pixels": size, "ready_s": time.perf_counter() - started}
            row["light_s"] = min(_timed(scene, turned) for _ in range(REPEATS))
            yield row | {"camera_s": min(_timed(scene, nearer) for _ in range(REPEATS))}


def _unchanged(scene: object) -> None:
    pass


def _timed(scene: object, change: Callable[[object], None]) -> float:
    """Wall seconds of a change and the first look after it."""
    from full_geometry.integrators.bssrdf import is_bssrdf

    started = time.perf_counter()
    change(scene)
    integrator = scene.integrator()
    draw = integrator.preview if is_bssrdf(integrator) else partial(integrator.preview, glints=True)
    np.array(draw(scene, scene.sensors()[0], 0, 1))
    return time.perf_counter() - started


def bench_first_images(variant: str, size: int, training: float = TRAINING) -> Iterator[Row]:
    """Wall seconds of the first image of a new process: kernels not known, then in the cache.

    Imports, the scene and the image of 16 samples a pixel count; a `full_geometry` is trained before.
    """
    use_mitsuba(variant)
    from benchmarks.lit_objects import LitObject, train

    with TemporaryDirectory() as weights:
        for way in FIRST:
            if way.startswith("full_geometry"):
                if not training:
                    continue
                train(LitObject(*EDITED), training, Path(weights))
            with TemporaryDirectory() as home:
                seconds = [_first(variant, size, way, home, weights) for _ in range(2)]
            yield {"way": way, "pixels": size, "empty_s": seconds[0], "known_s": seconds[1]}


def _first(variant: str, size: int, way: str, home: str, weights: str) -> float:
    """Wall seconds of a process that renders one image, with the kernels that a home has."""
    from halfspace_sss.neural.store import ENVIRONMENT_VARIABLE

    caches = {"HOME": home, "OPTIX_CACHE_PATH": home, "CUDA_CACHE_PATH": home, ENVIRONMENT_VARIABLE: weights}
    call = f"from benchmarks.bench_renders import first_image; first_image({variant!r}, {size}, {way!r}, {weights!r})"
    started = time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", call], check=True, timeout=PATIENCE, env={**os.environ, **caches},
        cwd=Path(__file__).parents[1],
    )  # fmt: skip
    return time.perf_counter() - started


def first_image(variant: str, size: int, way: str, folder: str) -> None:
    """One image of `EDITED`, as a process of its own makes it."""
    use_mitsuba(variant)
    import mitsuba as mi

    from benchmarks.lit_objects import LitObject
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    model, _, light = way.partition(", ")
    found = LitObject(*EDITED).description(size, Path(folder))
    model = PATH_TRACED if model == WALKS else model
    np.array(mi.render(load_scene(found, model, settings={"light": light} if light else {}), spp=16))
