"""Views: images of known cameras, what of them counts, and whether they are held out."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from full_geometry.geometry.sensors import camera_rays
from full_geometry.surface.textured import linear_of_srgb
from halfspace_sss.checks import check_choice, check_count, did_you_mean
from halfspace_sss.provenance import read_text

TRANSFERS = ("linear", "srgb")
KEYS = ("image", "sensor", "transfer", "mask", "held_out")
SATURATED = 1.0  # of files with 8 or 16 bits


@dataclass(frozen=True, eq=False)
class GivenView:
    """An image of a scene.

    Args:
        name: in messages.
        sensor: number of the camera.
        image: linear radiance, (height, width, channels).
        counts: which pixels count, (height, width).
        held_out: whether it only tests the fit.
    """

    name: str
    sensor: int
    image: np.ndarray
    counts: np.ndarray
    held_out: bool = False

    @classmethod
    def of(
        cls, name: str, sensor: int, image: ArrayLike, mask: ArrayLike | None = None, held_out: bool = False
    ) -> GivenView:
        """Check an image of any kind; pixels count where `mask` is > 0.5.

        Raises:
            ValueError: a pixel that counts is not finite, none counts, those that do are dark or below 0 in their mean,
                or the sizes of image and mask differ.
        """
        image = np.asarray(image, dtype=np.float32)
        if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
            raise ValueError(f"image {name} must be (height, width, channels), got the shape {image.shape}")
        image = image[..., :3]
        counts = np.ones(image.shape[:2], bool) if mask is None else np.asarray(mask) > 0.5
        if counts.shape != image.shape[:2]:
            raise ValueError(f"mask of {name} must be of the size of the image {image.shape[:2]}, got {counts.shape}")
        wrong = counts & ~np.isfinite(image).all(axis=2)
        if wrong.any():
            raise ValueError(f"image {name} must be finite, got {int(wrong.sum())} pixels that are not")
        if not counts.any():
            raise ValueError(f"image {name} must have a pixel that counts, got none of {counts.size}")
        if not (mean := float(image[counts].mean())) > 0:
            raise ValueError(f"image {name} must have a mean above 0, got {mean:.3g}")
        if below := int((image[counts] < 0).any(axis=1).sum()):
            warnings.warn(f"image {name}: {below} pixels below 0 count as they are, as noise about black", stacklevel=3)
        return cls(name, sensor, np.where(counts[..., None], image, 0), counts, held_out)


def read_views(path: str | Path) -> list[GivenView]:
    """The views of a JSON file: {"views": [{"image": "a.exr", "sensor": 0}, ...]}.

    A view may have `transfer` (`srgb` or `linear`; must be given for files that are no EXR), `mask` (an image, counts
    where > 0.5) and `held_out` (false). Paths are relative to the file. Saturated pixels do not count, with a warning.

    Raises:
        ValueError: the file or an image cannot be read, a key is unknown or missing, or as `GivenView.of`.
    """
    path = Path(path)
    try:
        content = json.loads(read_text(path))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: must be a readable JSON file, got {error}") from error
    if not isinstance(content, dict) or content.keys() != {"views"}:
        got = f"the keys {', '.join(content)}" if isinstance(content, dict) else f"a {type(content).__name__}"
        raise ValueError(f'{path}: must be an object {{"views": [...]}}, got {got}')
    rows = content["views"]
    if not isinstance(rows, list) or not rows:
        raise ValueError(f"{path}: views must be a list with an image or more, got {rows!r}")
    return [_view(path, row) for row in rows]


def _view(path: Path, row: object) -> GivenView:
    if not isinstance(row, dict) or "image" not in row:
        raise ValueError(f"{path}: a view must have `image`, got {row!r}")
    for key in row.keys() - set(KEYS):
        raise ValueError(f"{path}: {key} must be one of {', '.join(KEYS)}{did_you_mean(key, KEYS)}")
    for key, kind, said in (("image", str, "a file"), ("mask", str, "a file"), ("held_out", bool, "true or false")):
        if not isinstance(row.get(key, kind()), kind):
            raise ValueError(f"{path}: {key} must be {said}, got {row[key]!r}")
    name, sensor = row["image"], row.get("sensor", 0)
    check_count(f"{path}: sensor of {name}", sensor, 0)
    exact = name.lower().endswith(".exr")
    if not exact and "transfer" not in row:
        raise ValueError(f"{path}: {name} must have a transfer, linear or srgb, as it is no EXR, got none")
    transfer = row.get("transfer", "linear")
    check_choice(f"{path}: transfer of {name}", transfer, TRANSFERS)
    image = _pixels(path.parent / name)
    mask = _pixels(path.parent / row["mask"]).mean(axis=2) > 0.5 if "mask" in row else np.ones(image.shape[:2], bool)
    full = (image[..., :3] >= SATURATED).any(axis=2) if not exact else np.zeros(image.shape[:2], bool)
    if mask.shape == full.shape and (full & mask).any():
        warnings.warn(f"{name}: {int((full & mask).sum())} saturated pixels do not count", stacklevel=3)
        mask = mask & ~full
    image = linear_of_srgb(image) if transfer == "srgb" else image
    return GivenView.of(name, sensor, image, mask, row.get("held_out", False))


def _pixels(path: Path) -> np.ndarray:
    """The values of an image file; those with 8 or 16 bits in [0, 1]."""
    try:
        bitmap = mi.Bitmap(str(path))
    except RuntimeError as error:
        raise ValueError(f"{path} must be an image, got {str(error).splitlines()[-1]}") from error
    data, names = np.array(bitmap), [channel.name for channel in bitmap.struct_()]
    if len(names) > 4 and {"R", "G", "B"} <= set(names):  # with its variance, as `render` writes it
        data = data[..., [names.index(channel) for channel in "RGB"]]
    scale = np.iinfo(data.dtype).max if np.issubdtype(data.dtype, np.integer) else 1.0
    data = data.astype(np.float32) / np.float32(scale)
    return data if data.ndim == 3 else data[..., None]


def check_views(scene: mi.Scene, views: Sequence[GivenView], shape: mi.Shape) -> None:
    """Refuse views that do not belong to a scene.

    Raises:
        ValueError: a sensor does not exist, or its film is of another size or number of channels than the image; all
            views are held out; or the object is seen by none that is not.
    """
    seen, channels = 0, len(mi.Spectrum(0))
    for view in views:
        if view.sensor >= len(scene.sensors()):
            n = len(scene.sensors())
            raise ValueError(f"sensor of {view.name} must be below {n}, the number of sensors, got {view.sensor}")
        width, height = (int(v) for v in scene.sensors()[view.sensor].film().crop_size())
        if view.image.shape != (height, width, channels):
            raise ValueError(
                f"image {view.name} must be {width} x {height} of {channels} channels as sensor {view.sensor}, got "
                f"{view.image.shape[1]} x {view.image.shape[0]} of {view.image.shape[2]}"
            )
        seen += 0 if view.held_out else _seen(scene, scene.sensors()[view.sensor], shape)
    if all(view.held_out for view in views):
        raise ValueError("views must have one that is not held out, got none")
    if seen == 0:
        raise ValueError(f"object {shape.id()} must be seen by a view, got none of {len(views)} that shows it")


def _seen(scene: mi.Scene, sensor: mi.Sensor, shape: mi.Shape) -> int:
    """How many of the rays of a camera meet a shape."""
    si = scene.ray_intersect(camera_rays(sensor, 4, (0, 0))[0])
    return int(dr.count(si.is_valid() & (si.shape == mi.ShapePtr(shape)))[0])
