"""Walks from the camera that serve twice: their light makes an image, their first exits are data for learning."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.sensors import camera_rays, seeded
from full_geometry.integrators.walk_paths import FirstExits
from full_geometry.scenes.reference_store import Reference, finite_pixels, load, save
from full_geometry.settings import Settings
from full_geometry.walk.media import WalkMedia

TRIAL = 2**31  # number of a pass that is no part of the image
PASSES = "passes of objects"


class CameraWalks:
    """Passes by `translucent_walk` with the depths of the integrator that is to render the scene afterwards.

    The seed of a pass follows from that of the run, the object that is learnt and the number of the pass. One that the
    image holds already, as after a run that was killed, is traced again for its exits only.

    Args:
        settings: of the integrator `bssrdf`.
        path: of the image, an EXR as of `reference.render`; gone on with if it is there.
        about: what is rendered, see `Reference.about`.
        progress: called with the image after each pass.
    """

    def __init__(
        self, scene: mi.Scene, settings: Settings, sensor: int, seed: int, path: Path, about: dict[str, Any],
        progress: Callable[[Reference], None] | None = None,
    ) -> None:  # fmt: skip

        self.scene, self.sensor, self.seed, self.path = scene, scene.sensors()[sensor], seed, path
        self.integrator = mi.load_dict({"type": "translucent_walk", **settings.shared()})
        self.progress, self.about = progress, {**about, PASSES: {}}
        self.found: Reference | None = load(path) if path.exists() else None

    def check(self) -> None:
        """ValueError if walks cannot be traced in the scene, say for a camera inside an object."""
        self.integrator.tracer(self.scene)

    @property
    def pixels(self) -> int:
        """Camera rays of one sample per pixel."""
        return int(np.prod(np.array(self.sensor.film().crop_size())))

    def hits(self, shape: mi.Shape) -> int:
        """About how many paths of one sample per pixel meet an object first."""

        media = self.integrator.tracer(self.scene).visitor.media
        with dr.suspend_grad():
            met = FirstExits.of(self.scene, media, camera_rays(self.sensor, 1, (self.seed, TRIAL))[0])
            return int(dr.count(met.object == self._number(media, shape))[0])

    def exits(self, shape: mi.Shape, number: int, spp: int) -> list[FirstExits]:
        """First exits of the paths that meet an object first, from a pass of spp samples per pixel.
        `number`: of the pass; `TRIAL` for one that is no part of the image."""
        name, kept = shape.id(), []
        media = self.integrator.tracer(self.scene).visitor.media
        k = self._number(media, shape)
        seed = seeded(self.seed, 1, zlib.crc32(name.encode()), number)
        started = time.perf_counter()
        with dr.suspend_grad():
            image = self.integrator.render(
                self.scene, self.sensor, mi.UInt32(seed), spp,
                keep=lambda each: kept.append(each.of_object(k)),
            )  # fmt: skip
        if number != TRIAL:
            self._add(name, number, finite_pixels("walks from the camera", image), spp, time.perf_counter() - started)
        return kept

    @staticmethod
    def _number(media: WalkMedia, shape: mi.Shape) -> int:
        """The number of an object among those of the walk."""
        (k,) = (k for k, obj in enumerate(media.objects) if obj.shape is shape or obj.shape.id() == shape.id())
        return k

    def _add(self, name: str, number: int, image: np.ndarray, spp: int, seconds: float) -> None:
        result = self.found or Reference.empty(image.shape, self.about)
        passes = result.about.get(PASSES, {})
        if number >= passes.get(name, 0):
            result = result.add(image, spp, seconds)
            self.found = replace(result, about={**result.about, PASSES: {**passes, name: number + 1}})
        if self.progress:
            self.progress(self.found)

    def save(self) -> None:
        if self.found is not None:
            save(self.path, self.found)
