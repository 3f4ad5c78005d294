"""A finished render as what people look at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mitsuba as mi
import numpy as np


@dataclass(frozen=True, eq=False)
class Picture:
    """A render to be drawn.

    Args:
        title: name of the scene and the model.
        image: linear radiance (H, W, 3).
        numbers: name -> what is known of it.
        caption: a sentence.
        scene, sensor: Mitsuba scene and number of the sensor, to render guides for a denoiser.
        denoise: whether an image without noise is asked for.
        emission: its part that has no noise to take out (H, W, 3): emitters that the camera sees, at once or in the
            mirror of an object; None where that is not known.
    """

    title: str
    image: np.ndarray
    numbers: Mapping[str, str]
    caption: str
    scene: mi.Scene
    sensor: int
    denoise: bool
    emission: np.ndarray | None = None

    def png(self, image: np.ndarray | None = None) -> bytes:
        """The image as a display shows it."""
        return as_png(self.image if image is None else image)

    def exr(self, image: np.ndarray) -> bytes:
        """An image as it is."""
        return as_exr(image)


def as_exr(image: np.ndarray) -> bytes:
    """Numbers (H, W, channels) as they are."""
    return _written(mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32)), mi.Bitmap.FileFormat.OpenEXR)


def as_png(image: np.ndarray) -> bytes:
    """Linear radiance (H, W, channels) as a display shows it."""
    return _written(mi.util.convert_to_bitmap(mi.TensorXf(image.astype(np.float32))), mi.Bitmap.FileFormat.PNG)


def _written(bitmap: mi.Bitmap, kind: mi.Bitmap.FileFormat) -> bytes:
    stream = mi.MemoryStream()
    bitmap.write(stream, kind)
    return bytes(stream.raw_buffer())
