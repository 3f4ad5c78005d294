"""Images of a render as it goes on: walks alone, walks that learn and then the model, the model trained before."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from figures.computing.scenes import bunny_scene
from halfspace_sss.rendering.scenes import online, reference
from halfspace_sss.rendering.scenes.combined import combined
from halfspace_sss.rendering.scenes.reference_store import Reference

__all__ = ["Snapshots", "modelled", "trained_online", "walked"]

STEP = 1.25  # of the time from one image that is kept to the next


class Snapshots:
    """Images at times that grow by a factor; the clock stands still while one is kept.

    Attributes:
        times: seconds since the start.
        images: linear radiance (H, W, 3) at those times.
        spp: samples per pixel in them.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.images: list[np.ndarray] = []
        self.spp: list[int] = []
        self._started = time.monotonic()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._started

    def add(self, found: Reference, last: bool = False) -> None:
        """Keep an image, if it is time or the last one."""
        now = self.seconds
        if self.times and now < STEP * self.times[-1] and not last:
            return
        if last and self.spp and self.spp[-1] == found.spp:
            return
        now = max(now, self.times[-1] + 1e-6) if self.times else now
        self.times.append(now)
        self.images.append(found.mean[..., :3].astype(np.float32))
        self.spp.append(found.spp)
        self._started += self.seconds - now


def _scene(p: dict[str, Any], model: str, train_seconds: float) -> Any:
    from halfspace_sss.rendering.scenes.scene_files import open_scene

    settings = {"train_seconds": train_seconds, "train_error": p["train_error"]}
    return open_scene(bunny_scene(p["material"], p["size"], p["lights"]), model, settings=settings)


def trained_online(p: dict[str, Any], folder: Path, seconds: float, train_seconds: float) -> dict[str, Any]:
    """The object is learnt and rendered from nothing; weights must not be there.

    Args:
        p: material, size, lights, seed, train_error and model.
        folder: for the image and its parts.
        seconds: in all, about.
        train_seconds: of them at most for learning.

    Returns:
        The snapshots, the seconds at the switch, and what `about` tells of the training.
    """
    found, walks, switch = Snapshots(), [None], [0.0]

    def traced(image: Reference) -> None:
        walks[0] = image
        found.add(image)

    def rendered(image: Reference) -> None:
        if not switch[0]:
            switch[0] = found.seconds - image.seconds
            found.add(walks[0], last=True)
        found.add(combined(walks[0], image))

    image = online.render(
        _scene(p, p["model"], train_seconds), folder / "online.exr", seed=p["seed"], walked=traced, progress=rendered,
        seconds=max(seconds - train_seconds, 0.1), interval=1e9,
    )  # fmt: skip
    found.add(image, last=True)
    return {"snapshots": found, "switch": switch[0], "training": image.about["training"]}


def modelled(p: dict[str, Any], folder: Path, seconds: float) -> Snapshots:
    """The model renders with weights that are there."""
    return _rendered(_scene(p, p["model"], 0.0), folder / "model.exr", p["seed"] + 1, seconds)


def walked(p: dict[str, Any], folder: Path, seconds: float) -> Snapshots:
    """Walks alone."""
    from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED

    return _rendered(_scene(p, PATH_TRACED, 0.0), folder / "walked.exr", p["seed"] + 2, seconds)


def _rendered(scene: Any, path: Path, seed: int, seconds: float) -> Snapshots:
    integrator = scene.integrator()
    if hasattr(integrator, "prepare"):
        integrator.prepare(scene)
    found = Snapshots()
    image = reference.render(scene, path, seed=seed, seconds=seconds, interval=1e9, resume=False, progress=found.add)
    found.add(image, last=True)
    return found
