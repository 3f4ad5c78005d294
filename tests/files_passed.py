"""Counts the files of this project that one call passes: `python -m tests.files_passed`.

A call is run once, so that what is imported, compiled or read first is there, and then followed: every Python file in
which a function begins counts once. The camera sample is recorded anew, as Dr.Jit repeats a kernel without Python.
"""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import halfspace_sss as sss

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("figures", "full_geometry", "analytic_models", "halfspace_sss")
MEDIUM = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}


def files_passed(call: Callable[[], Any]) -> list[str]:
    """Files whose functions a call begins, in the order of the first time; the file of the call itself left out."""
    passed: dict[str, None] = {}

    def follow(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code.co_name != "<module>":
            passed.setdefault(frame.f_code.co_filename)

    threading.setprofile(follow)
    sys.setprofile(follow)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    roots = tuple(str(ROOT / package) for package in PACKAGES)
    return [str(Path(name).relative_to(ROOT)) for name in passed if name.startswith(roots)]


def _curves() -> Callable[[], Any]:
    marble = sss.materials.load("marble").medium
    return lambda: sss.curves(marble, models=["better_dipole"], n_paths=256)


def _scene(model: str) -> Any:
    import mitsuba as mi

    view = mi.ScalarTransform4f().look_at([0, 1, 8], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "bssrdf", "mm_per_unit": 3.0},
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": view, "film": film},
            "wax": {"type": "sphere", "bsdf": {"type": "translucent", **MEDIUM, "model": model}},
            "light": {"type": "constant"},
        }
    )


def _learn(scene: Any, folder: Path, seed: int) -> Any:
    from full_geometry.learning.learners import learner

    how = {"object": None, "seconds": 0.5, "target_error": None, "folder": folder, "work": None, "progress": None}
    return learner("full_geometry").train(scene, seed=seed, **how)


def _sample(folder: Path) -> Callable[[], Any]:
    """One camera sample of an object that has been learnt, from the camera ray on: models are made before."""
    import mitsuba as mi

    from halfspace_sss.neural.store import ENVIRONMENT_VARIABLE

    scene = _scene("full_geometry")
    _learn(scene, folder, 0)
    os.environ[ENVIRONMENT_VARIABLE] = str(folder)
    integrator, sampler = scene.integrator(), mi.load_dict({"type": "independent"})
    integrator.prepare(scene)

    def sample() -> None:
        sampler.seed(1, 16)
        ray, _ = scene.sensors()[0].sample_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
        integrator.sample(scene, sampler, ray, None, True)

    return sample


def main() -> None:
    """Print the number of files of each call, and their names with -v."""
    import mitsuba as mi

    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    warnings.simplefilter("ignore")
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "again").mkdir()
        scene = _scene("full_geometry")
        calls = {
            "curves": _curves(),
            "one sample of full_geometry": _sample(folder),
            "train object": lambda: _learn(scene, folder / "again", 1),
        }
        for what, call in calls.items():
            call()
            found = files_passed(call)
            print(f"{what:<30} {len(found)}", flush=True)
            if "-v" in sys.argv:
                print(*(f"    {file}" for file in found), sep="\n")


if __name__ == "__main__":
    main()
