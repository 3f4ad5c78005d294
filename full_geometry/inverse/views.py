"""Views: images of known cameras, what of them counts, and whether they are held out."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from full_geometry.geometry.sensors import camera_rays
from full_geometry.scenes.scene_files import like, put
from full_geometry.surface.textured import linear_of_srgb
from halfspace_sss.checks import check_choice, check_count, did_you_mean
from halfspace_sss.provenance import read_text

TRANSFERS = ("linear", "srgb")
KEYS = ("image", "sensor", "camera", "edits", "transfer", "mask", "held_out")
CAMERA = {"origin": 3, "target": 3, "up": 3, "fov": 1}  # keys of a camera, and how many numbers each has
SATURATED = 1.0  # of files with 8 or 16 bits


@dataclass(frozen=True, eq=False)
class GivenView:
    """An image of a scene.

    Args:
        name: in messages.
        sensor: the camera, or its number in the scene.
        image: linear radiance, (height, width, channels).
        counts: how much each pixel counts, (height, width), in [0, 1].
        held_out: whether it only tests the fit.
        edits: values of the scene in this view by their key in `mitsuba.traverse`, such as `lamp.position`.
    """

    name: str
    sensor: int | mi.Sensor
    image: np.ndarray
    counts: np.ndarray
    held_out: bool = False
    edits: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, name: str, sensor: int | mi.Sensor, image: ArrayLike, mask: ArrayLike | None = None,
        held_out: bool = False, edits: Mapping[str, Sequence[float]] | None = None,
    ) -> GivenView:  # fmt: skip
        """Check an image of any kind; pixels count by `mask`, which is clipped to [0, 1].

        Raises:
            ValueError: a pixel that counts is not finite, none counts, those that do are dark or below 0 in their mean,
                or the sizes of image and mask differ.
        """
        image = np.asarray(image, dtype=np.float32)
        if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
            raise ValueError(f"image {name} must be (height, width, channels), got the shape {image.shape}")
        image = image[..., :3]
        counts = np.ones(image.shape[:2]) if mask is None else np.clip(np.asarray(mask, dtype=float), 0, 1)
        if counts.shape != image.shape[:2]:
            raise ValueError(f"mask of {name} must be of the size of the image {image.shape[:2]}, got {counts.shape}")
        seen = counts > 0
        wrong = seen & ~np.isfinite(image).all(axis=2)
        if wrong.any():
            raise ValueError(f"image {name} must be finite, got {int(wrong.sum())} pixels that are not")
        if not seen.any():
            raise ValueError(f"image {name} must have a pixel that counts, got none of {counts.size}")
        if not (mean := float(image[seen].mean())) > 0:
            raise ValueError(f"image {name} must have a mean above 0, got {mean:.3g}")
        if below := int((image[seen] < 0).any(axis=1).sum()):
            warnings.warn(f"image {name}: {below} pixels below 0 count as they are, as noise about black", stacklevel=3)
        return cls(name, sensor, np.where(seen[..., None], image, 0), counts, held_out, edits or {})

    def camera(self, scene: mi.Scene) -> mi.Sensor:
        """Its camera: its own, or that of a scene."""
        return scene.sensors()[self.sensor] if isinstance(self.sensor, int) else self.sensor


def read_views(path: str | Path) -> list[GivenView]:
    """The views of a JSON file: {"views": [{"image": "a.exr", "sensor": 0}, ...]}.

    A view may have `transfer` (`srgb` or `linear`; must be given for files that are no EXR), `mask` (an image in
    [0, 1], how much each pixel counts), `held_out` (false), `edits` as of `GivenView`, and instead of `sensor` a
    `camera` {"origin": [...], "target": [...], "up": [...], "fov": 10}, in degrees along x: its film has the part of
    the image that counts. Paths are relative to the file. Saturated pixels do not count, with a warning.

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
    kinds = {"image": (str, "a file"), "mask": (str, "a file"), "held_out": (bool, "true or false"),
             "camera": (dict, "an object"), "edits": (dict, "an object")}  # fmt: skip
    for key, (kind, said) in kinds.items():
        if not isinstance(row.get(key, kind()), kind):
            raise ValueError(f"{path}: {key} must be {said}, got {row[key]!r}")
    name, sensor = row["image"], row.get("sensor", 0)
    check_count(f"{path}: sensor of {name}", sensor, 0)
    if {"sensor", "camera"} <= row.keys():
        raise ValueError(f"{path}: {name} must have a sensor or a camera, got both")
    exact = name.lower().endswith(".exr")
    if not exact and "transfer" not in row:
        raise ValueError(f"{path}: {name} must have a transfer, linear or srgb, as it is no EXR, got none")
    transfer = row.get("transfer", "linear")
    check_choice(f"{path}: transfer of {name}", transfer, TRANSFERS)
    image = _pixels(path.parent / name)
    mask = _pixels(path.parent / row["mask"]).mean(axis=2) if "mask" in row else np.ones(image.shape[:2])
    full = (image[..., :3] >= SATURATED).any(axis=2) if not exact else np.zeros(image.shape[:2], bool)
    if mask.shape == full.shape and (full & (mask > 0)).any():
        warnings.warn(f"{name}: {int((full & (mask > 0)).sum())} saturated pixels do not count", stacklevel=3)
        mask = np.where(full, 0, mask)
    image = linear_of_srgb(image) if transfer == "srgb" else image
    if "camera" in row and mask.shape == image.shape[:2] and (mask > 0).any():
        rows, columns = (np.flatnonzero((mask > 0).any(axis=axis)) for axis in (1, 0))
        top, left, bottom, right = rows[0], columns[0], rows[-1] + 1, columns[-1] + 1
        sensor = _camera(f"{path}: camera of {name}", row["camera"], image.shape[:2], (left, top, right, bottom))
        image, mask = (each[top:bottom, left:right] for each in (image, mask))
    return GivenView.of(name, sensor, image, mask, row.get("held_out", False), row.get("edits"))


def _camera(name: str, camera: dict[str, Any], size: tuple[int, int], part: tuple[int, int, int, int]) -> mi.Sensor:
    """A perspective camera for a part (left, top, right, bottom) of an image of a size (height, width)."""
    if camera.keys() != CAMERA.keys():
        raise ValueError(f"{name} must have {', '.join(CAMERA)}, got {', '.join(camera) or 'none'}")
    values = {key: numbers_of(f"{key} of {name}", value, CAMERA[key]) for key, value in camera.items()}
    left, top, right, bottom = map(int, part)
    film = {"type": "hdrfilm", "height": size[0], "width": size[1], "pixel_format": "rgb", "rfilter": {"type": "box"}}
    film |= {"crop_offset_x": left, "crop_offset_y": top, "crop_width": right - left, "crop_height": bottom - top}
    pose = mi.ScalarTransform4f().look_at(*(values[key] for key in ("origin", "target", "up")))
    if not np.isfinite(np.array(pose.matrix)).all():
        raise ValueError(f"up of {name} must not be along its view, got {camera['up']}")
    return mi.load_dict({"type": "perspective", "fov": values["fov"][0], "to_world": pose, "film": film})


def numbers_of(name: str, value: object, count: int) -> list[float]:
    """So many finite numbers.
    ValueError if they are others."""
    try:
        found = np.array(value, dtype=float).ravel()
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, got {value!r}") from None
    if found.size != count or not np.isfinite(found).all():
        raise ValueError(f"{name} must be {count} finite number{'s' * (count > 1)}, got {value!r}")
    return found.tolist()


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
    ValueError if a sensor does not exist, or its film is of another size or number of channels than the image; all
    views are held out; one that is not does not show the object; or views edit different keys, or one that is no
    number of the scene."""
    blind, channels = [], len(mi.Spectrum(0))
    for view in views:
        if isinstance(view.sensor, int) and view.sensor >= len(scene.sensors()):
            n = len(scene.sensors())
            raise ValueError(f"sensor of {view.name} must be below {n}, the number of sensors, got {view.sensor}")
        width, height = (int(v) for v in view.camera(scene).film().crop_size())
        if view.image.shape != (height, width, channels):
            raise ValueError(
                f"image {view.name} must be {width} x {height} of {channels} channels as sensor {view.sensor}, got "
                f"{view.image.shape[1]} x {view.image.shape[0]} of {view.image.shape[2]}"
            )
        if not view.held_out and not _seen(scene, view.camera(scene), shape):
            blind.append(view.name)
        if view.edits.keys() != views[0].edits.keys():
            told = ", ".join(views[0].edits) or "none"
            raise ValueError(f"edits of {view.name} must be of the keys {told} as of {views[0].name}, got others")
        _edited(mi.traverse(scene), view)
    if all(view.held_out for view in views):
        raise ValueError("views must have one that is not held out, got none")
    if blind:
        raise ValueError(f"fitted views must show object {shape.id()}, got nothing of it in {', '.join(blind)}")


def edit(scene: mi.Scene, view: GivenView) -> None:
    """Bring a scene to what its edits say of a view."""
    if view.edits:
        put(scene, _edited(mi.traverse(scene), view), list(view.edits))


def _edited(parameters: mi.SceneParameters, view: GivenView) -> dict[str, Any]:
    """Values of edits in the types of a scene."""
    result = {}
    for key, value in view.edits.items():
        name = f"{key} in edits of {view.name}"
        old = parameters[key] if key in parameters else None
        if old is None or not (isinstance(old, float) or dr.is_float_v(old)):
            near = did_you_mean(key, list(parameters.keys()))
            raise ValueError(f"{name} must be the key of numbers of the scene{near}")
        result[key] = like(old, np.array(numbers_of(name, value, np.size(old))))
    return result


def _seen(scene: mi.Scene, sensor: mi.Sensor, shape: mi.Shape) -> int:
    """How many of the rays of a camera meet a shape."""
    si = scene.ray_intersect(camera_rays(sensor, 4, (0, 0))[0])
    return int(dr.count(si.is_valid() & (si.shape == mi.ShapePtr(shape)))[0])
