"""Long renders in passes: they can be killed and resumed, and stop at an error, a number of passes or a time.

    reference.render("scene.xml", "truth.exr", integrator={"type": "translucent_walk"}, target_error=0.01)
    truth = reference.load("truth.exr")             # .mean, .variance, .standard_error, .about

The seed of pass k depends on the seed of the run and on k only, so that a resumed run gives the same image.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from halfspace_sss.provenance import check_folder, provenance
from halfspace_sss.rendering.scenes.reference_store import Reference, load, save

__all__ = ["Reference", "load", "render", "scene_hash"]

FEWEST_PASSES = 8  # before the spread of the passes is trusted to stop a run
Progress = Callable[[Reference], None]


def render(
    scene: Any,
    path: str | os.PathLike,
    *,
    integrator: dict | None = None,
    sensor: int = 0,
    spp_per_pass: int = 16,
    seed: int = 0,
    passes: int | None = None,
    target_error: float | None = None,
    seconds: float | None = None,
    interval: float = 30.0,
    progress: Progress | None = None,
) -> Reference:
    """Render a scene in passes into an EXR file, or go on with the file that is there.

    The run ends as soon as one of `passes`, `target_error` and `seconds` is reached; all count what the file holds
    already. Under an interrupt or an error the passes so far are kept.

    Args:
        scene: a dict, the path of an XML file, or a Mitsuba scene.
        path: of the EXR file; a JSON file beside it repeats its header.
        integrator: dict of the integrator; by default that of the scene.
        sensor: number of the sensor.
        spp_per_pass: samples per pixel of a pass.
        seed: of the run.
        passes: number of passes in all.
        target_error: `Reference.relative_error` to come down to; looked at from the 8th pass on.
        seconds: of rendering in all.
        interval: seconds between writes of the file; 0 writes after every pass.
        progress: called after each pass.

    Raises:
        ValueError: an argument is out of range, the file is damaged or of another render, or a pass has values that
            are not finite.
    """
    _check(passes, target_error, seconds, spp_per_pass, seed, interval)
    path = Path(path)
    if path.suffix.lower() != ".exr":
        raise ValueError(f"path must end in .exr, got {str(path)!r}")
    check_folder(path.parent)
    scene, integrator = _load(scene, integrator)
    about = _about(scene, integrator, sensor, spp_per_pass, seed)
    found = _resume(path, about) if path.exists() else None
    written = found

    def is_done() -> bool:
        return found is not None and _ends(found, passes, target_error, seconds)

    last = time.monotonic()
    try:
        while not is_done():
            found = _pass(found, scene, integrator, sensor, about)
            if time.monotonic() - last >= interval:
                save(path, found)
                written, last = found, time.monotonic()
            if progress is not None:
                progress(found)
    finally:
        if found is not None and found is not written:
            save(path, found)
    return found


def _pass(found: Reference | None, scene: Any, integrator: Any, sensor: int, about: dict) -> Reference:
    """One more pass."""
    import mitsuba as mi

    number = found.passes if found else 0
    started = time.perf_counter()
    seed = int(np.random.SeedSequence([about["seed"], number]).generate_state(1)[0])
    image = mi.render(scene, sensor=sensor, integrator=integrator, seed=seed, spp=about["spp_per_pass"])
    image = np.array(image, dtype=np.float32)
    image = image[..., None] if image.ndim == 2 else image
    if not np.isfinite(image).all():
        bad = int((~np.isfinite(image)).any(axis=2).sum())
        raise ValueError(f"pass {number} must be finite, got {bad} pixels that are not")
    start = found or Reference(np.zeros(image.shape), np.zeros(image.shape), 0, 0.0, about)
    return start.add(image, time.perf_counter() - started)


def _ends(found: Reference, passes: int | None, target_error: float | None, seconds: float | None) -> bool:
    certain = target_error is not None and found.passes >= FEWEST_PASSES and found.relative_error <= target_error
    return (
        certain or (passes is not None and found.passes >= passes) or (seconds is not None and found.seconds >= seconds)
    )


def _check(
    passes: int | None, target_error: float | None, seconds: float | None, spp: int, seed: int, interval: float
) -> None:
    if passes is None and target_error is None and seconds is None:
        raise ValueError("one of passes, target_error and seconds must be given, got none")
    for name, value, least in (("passes", passes, 1), ("spp_per_pass", spp, 1), ("seed", seed, 0)):
        if value is not None and (isinstance(value, bool) or int(value) != value or value < least):
            raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
    for name, value in (("target_error", target_error), ("seconds", seconds)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be finite and > 0, got {value!r}")
    if not interval >= 0:
        raise ValueError(f"interval must be >= 0, got {interval!r}")


def _load(scene: Any, integrator: dict | None) -> tuple[Any, Any]:
    """The scene and its integrator as Mitsuba objects."""
    import mitsuba as mi

    if isinstance(scene, dict):
        scene = mi.load_dict(scene, parallel=False)
    elif isinstance(scene, (str, os.PathLike)):
        if not Path(scene).is_file():
            raise ValueError(f"scene must be a dict, a Mitsuba scene or a file, got {os.fspath(scene)!r}")
        scene = mi.load_file(os.fspath(scene), parallel=False)
    integrator = mi.load_dict(integrator) if integrator is not None else scene.integrator()
    if integrator is None:
        raise ValueError("integrator must be given, for the scene has none")
    return scene, integrator


def _about(scene: Any, integrator: Any, sensor: int, spp: int, seed: int) -> dict[str, Any]:
    import mitsuba as mi

    about = {
        "scene": scene_hash(scene, integrator),
        "integrator": str(integrator),
        "sensor": sensor,
        "spp_per_pass": int(spp),
        "seed": int(seed),
        "variant": mi.variant(),
    }
    return {**about, "provenance": provenance(**about)}


def scene_hash(scene: Any, integrator: Any) -> str:
    """SHA-256 of what Mitsuba tells of a scene in words and of all its parameters, without its own integrator."""
    import mitsuba as mi

    own = scene.integrator()
    lines = str(scene).splitlines()
    for line in str(own).splitlines() if own is not None else ():
        index = next((k for k, found in enumerate(lines) if line.strip() in found), None)
        if index is not None:
            del lines[index]
    # objects that are loaded in parallel stand in any order
    digest = hashlib.sha256("\n".join([*sorted(lines), str(integrator)]).encode())
    for key, value in sorted(mi.traverse(scene).items()):
        digest.update(key.encode())
        numbers = np.array(getattr(value, "matrix", value))
        digest.update(str(value).encode() if numbers.dtype == object else numbers.tobytes())
    return digest.hexdigest()


def _resume(path: Path, about: dict[str, Any]) -> Reference:
    """The file so far.

    Raises:
        ValueError: it is damaged or of another render.
    """
    found = load(path)
    for key in ("scene", "integrator", "sensor", "spp_per_pass", "seed", "variant"):
        if found.about.get(key) != about[key]:
            raise ValueError(
                f"{path} must be of the same render to go on with it: {key} is {found.about.get(key)!r} there and "
                f"{about[key]!r} here; choose another file or delete it"
            )
    versions = [p["provenance"]["versions"] for p in (found.about, about)]
    if versions[0] != versions[1]:
        raise ValueError(f"{path} must be of the same versions to go on with it, got {versions[0]} and {versions[1]}")
    return found
