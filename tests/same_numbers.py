"""Hashes of ten results for fixed seeds: `python -m tests.same_numbers` on two commits, to be compared by diff.

Each line says what was computed, its hash and its seconds. Times are compared as ratios of runs beside each other.
All light is sampled: precomputed light is a sum of rays by atomics, in another order and off by 1e-6 in each run.
"""

from __future__ import annotations

import hashlib
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from safetensors.numpy import load_file

import halfspace_sss as sss

MEDIUM = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}
MODELS = ["better_dipole", "neural", "forward_scattering_dipole"]


def _hash(*arrays: Any) -> str:
    return hashlib.md5(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()[:12]


def _scene(integrator: str, light: dict, **surface: Any) -> Any:
    import mitsuba as mi

    view = mi.ScalarTransform4f().look_at([0, 1, 8], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    floor = mi.ScalarTransform4f().translate([0, -1.01, 0]).rotate([1, 0, 0], -90).scale(5)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "mm_per_unit": 3.0, "light": "sampled"},
            "sensor": {"type": "perspective", "fov": 20.0, "to_world": view, "film": film},
            "wax": {"type": "sphere", "bsdf": {"type": "translucent", **MEDIUM, "model": "better_dipole", **surface}},
            "floor": {"type": "rectangle", "to_world": floor},
            "light": light,
        }
    )


def _image(integrator: str, light: dict, **surface: Any) -> Any:
    import mitsuba as mi

    return np.array(mi.render(_scene(integrator, light, **surface), spp=32, seed=3))


def _gradient() -> Any:
    import drjit as dr
    import mitsuba as mi

    scene = _scene("bssrdf", {"type": "constant"})
    parameters = mi.traverse(scene)
    key = next(k for k in parameters.keys() if k.startswith("light.radiance"))
    dr.enable_grad(parameters[key])
    dr.backward(dr.mean(mi.render(scene, parameters, spp=16, seed=1)))
    return np.array([f"{v:.4g}" for v in np.ravel(np.array(dr.grad(parameters[key])))])  # sums are atomic


def _traced(medium: sss.Medium) -> list[float]:
    found = sss.trace(medium, 0.8, 20_000, seed=1)
    return [found.reflectance("single").value, found.reflectance("multiple").value, found.n_events]


def _trained(medium: sss.Medium, folder: Path) -> list[np.ndarray]:
    """The weights of a network of one material, by few walks."""
    from halfspace_sss.neural.training import FAST

    recipe = replace(FAST, n_groups=16, events=2e6, how=replace(FAST.how, steps=30, validate_every=30))
    sss.neural.train(medium, recipe=recipe, seed=1, folder=folder)
    return _weights(folder)


def _learnt(medium: sss.Medium, folder: Path) -> list[np.ndarray]:
    """The weights of an object, by few walks."""
    import mitsuba as mi

    from full_geometry import Recipe, train

    recipe = Recipe(width=24, depth=2, batch=1024, chunk=2**13, reuse=2)
    train(mi.load_dict({"type": "sphere"}), medium, mm_per_unit=4.0, chunks=3, recipe=recipe, seed=1, folder=folder)
    return _weights(folder)


def _weights(folder: Path) -> list[np.ndarray]:
    """All arrays of all files, without the metadata, which holds seconds and versions."""
    files = sorted(folder.rglob("*.safetensors"))
    return [values for file in files for _, values in sorted(load_file(file).items())]


def _cases(folder: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    medium = sss.Medium(sigma_s=1.5, sigma_a=0.1, g=0.3, eta=1.4)
    sky = {"type": "constant"}
    ball = {"type": "sphere", "center": [1.5, 3, 2.5], "radius": 0.5, "emitter": {"type": "area"}}
    point = {"type": "point", "position": [1.5, 3, 2.5]}
    grid = np.geomspace(0.1, 10, 64)
    yield "trace", lambda: _traced(medium)
    yield "models", lambda: [sss.bssrdf(m, medium).eval(grid, 0.8, 0.3, 0.7, 1.0) for m in MODELS]
    yield "reflectances", lambda: [sss.measure.reflectance(sss.bssrdf(m, medium), 0.8) for m in MODELS]
    yield "exact", lambda: [medium.reflectance(), sss.Medium.from_reflectance(0.6, mfp=1.0, g=0.3, eta=1.4).albedo]
    for integrator in ("translucent_walk", "bssrdf"):
        yield f"{integrator} sky", lambda i=integrator: _image(i, sky)
        yield f"{integrator} ball", lambda i=integrator: _image(i, ball)
        yield f"{integrator} point", lambda i=integrator: _image(i, point)
    yield "neural ball", lambda: _image("bssrdf", ball, model="neural")
    yield "neural_shape ball", lambda: _image("bssrdf", ball, model="neural_shape")
    yield "gradient", _gradient
    yield "train material", lambda: _trained(medium, folder / "material")
    yield "train object", lambda: _learnt(medium, folder / "object")


def main() -> None:
    import mitsuba as mi

    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    warnings.simplefilter("ignore")
    only = sys.argv[1:]
    with TemporaryDirectory() as folder:
        for name, case in _cases(Path(folder)):
            if only and not any(word in name for word in only):
                continue
            start = time.process_time()
            values = case()
            arrays = values if isinstance(values, list) else [values]
            print(f"{name:24} {_hash(*map(np.asarray, arrays))} {time.process_time() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
