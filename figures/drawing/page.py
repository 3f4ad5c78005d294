"""One HTML page, without anything outside it, in which the images of scenes are flipped between and zoomed in step."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps  # without it there is no page, which must be known before one is drawn

from figures.computing.images import FLIP, RELATIVE_MSE, Shot, compared
from full_geometry.trade.image_differences import srgb
from halfspace_sss.provenance import JsonDict

if TYPE_CHECKING:
    from full_geometry.inverse.comparing import MaterialFit
    from full_geometry.scenes.reference_store import Picture


DIFFERENCE_SPAN = 1.0  # relative difference at the ends of the colours
QUALITY, MAP_QUALITY, LEVELS = 88, 70, 25  # of JPEG; of a map without loss, whichever is smaller
MAPS = {
    "flip": ("FLIP", "magma", ("no difference, 0", "1")),
    "difference": ("relative difference", "RdBu_r", ("darker, ≤ −1", "brighter, ≥ 1")),
}


def page(
    title: str, scenes: Mapping[str, Sequence[Shot]], *, exposure: float = 0.0, caption: str = "", notes: str = "",
    lower_is_better: Sequence[str] = (FLIP, RELATIVE_MSE),
) -> str:  # fmt: skip
    """The page as text, to be written as one file; the same arguments give the same text.

    Args:
        title: heading, and title of the window.
        scenes: name of a scene -> its images, the reference first. `figures.computing.images.compared` makes those with
            maps, `figures.computing.images.absent` keeps a place for what does not exist yet.
        exposure: stops at which the images are encoded; the slider of the page starts from there.
        caption: a sentence under the title.
        notes: what the numbers are, below the table.
        lower_is_better: columns of which the smallest number is set in bold; they come first, the first of them is
            repeated above each image.

    Raises:
        ValueError: there is no scene, a scene starts without an image, or its images and maps differ in size.
    """
    check_scenes(scenes)
    given = dict.fromkeys(column for shots in scenes.values() for shot in shots for column in shot.numbers)
    columns = [column for column in lower_is_better if column in given]
    columns += [column for column in given if column not in columns]
    data = {
        "scenes": [_scene(name, shots, exposure) for name, shots in scenes.items()],
        "columns": columns,
        "lower": list(lower_is_better),
        "maps": {kind: _map(kind) for kind in MAPS},
    }
    content = {name: html.escape(text) for name, text in (("title", title), ("caption", caption), ("notes", notes))}
    content |= {"style": _file("page.css"), "script": _file("page.js")}
    content["data"] = json.dumps(data, allow_nan=False, ensure_ascii=False).replace("</", "<\\/")
    return re.sub(r"\{\{(\w+)\}\}", lambda name: content[name[1]], _file("page.html"))


def _file(name: str) -> str:
    return resources.files("figures").joinpath("page_files", name).read_text(encoding="utf-8")


def check_scenes(scenes: Mapping[str, Sequence[Shot]]) -> None:
    """ValueError if there is no scene, one starts without an image, or its images and maps differ in size."""
    if not scenes:
        raise ValueError("scenes must hold at least one scene, got none")
    for name, shots in scenes.items():
        if not shots or shots[0].image is None:
            raise ValueError(f"scene {name!r} must start with the image of its reference, got none")
        labels = [shot.label for shot in shots]
        if len(set(labels)) < len(labels):
            raise ValueError(f"labels of scene {name!r} must differ, got {labels!r}")
        size = np.shape(shots[0].image)[:2]
        for shot in shots:
            for kind in ("image", "flip", "difference"):
                map_of = getattr(shot, kind)
                if map_of is not None and np.shape(map_of)[:2] != size:
                    told = f"must have the size {size}, got {map_of.shape}"
                    raise ValueError(f"{kind} of {shot.label!r} in {name!r} {told}")


def _scene(name: str, shots: Sequence[Shot], exposure: float) -> JsonDict:
    height, width = np.shape(shots[0].image)[:2]
    return {"name": name, "size": [width, height], "shots": [_shot(shot, exposure) for shot in shots]}


def _shot(shot: Shot, exposure: float) -> JsonDict:
    results: JsonDict = {"label": shot.label, "why": shot.why, "numbers": {}}
    for column, value in shot.numbers.items():
        plain = value if isinstance(value, str) else float(value)
        results["numbers"][column] = plain if isinstance(plain, str) or math.isfinite(plain) else str(plain)
    if shot.image is not None:
        # FLIP between images as they were and as they are shown differs by less than 0.006
        pixels = np.round(255 * srgb(shot.image, exposure)).astype(np.uint8)
        results["image"] = _address(pixels, pixels, QUALITY)
    for kind, low in (("flip", 0.0), ("difference", -DIFFERENCE_SPAN)):
        values = getattr(shot, kind)
        if values is not None:
            scaled = np.clip((np.asarray(values) - low) / (DIFFERENCE_SPAN - low), 0.0, 1.0)
            # in the 256 colours, or without loss in few of them
            few, colors = np.round((LEVELS - 1) * scaled) / (LEVELS - 1), _colors(MAPS[kind][1])
            few, full = (colors[np.round(255 * v).astype(np.uint8)] for v in (few, scaled))
            results[kind] = _address(few, full, MAP_QUALITY)
    return results


def _colors(name: str) -> np.ndarray:
    """The 256 colours of a colour map, (256, 3) bytes."""
    return np.round(255 * colormaps[name](np.arange(256))[:, :3]).astype(np.uint8)


def _map(kind: str) -> JsonDict:
    """What the legend of a map shows."""
    title, name, ends = MAPS[kind]
    colors = ["#" + bytes(color).hex() for color in _colors(name)[::17]]
    return {"title": title, "colors": colors, "ends": ends}


def _address(exact: np.ndarray, pixels: np.ndarray, quality: int) -> str:
    """A data address of pixels, (H, W, 3) bytes, without loss or as JPEG, whichever is smaller.
    Without lossy WebP, which has half of the resolution in colour, where noise is."""
    from PIL import Image

    results = []
    for data, kind, settings in (
        (exact, "webp", {"lossless": True}), (pixels, "jpeg", {"quality": quality, "subsampling": 0, "optimize": True})
    ):  # fmt: skip
        Image.fromarray(data).save(buffer := io.BytesIO(), kind, **settings)
        results.append(f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode())
    return min(results, key=len)


def render(picture: Picture) -> dict[str, bytes]:
    """{"html": page}, and with a denoised image {"denoised.exr", "denoised.png"}; on the page both can be flipped."""
    from full_geometry.scenes.reference_store import as_exr, as_png

    shots, files = [Shot("rendered", np.maximum(picture.image, 0.0), dict(picture.numbers))], {}
    if picture.clean is not None:
        clean, numbers = picture.clean
        shots.append(Shot("denoised", np.maximum(clean, 0.0), dict(numbers)))
        files = {"denoised.exr": as_exr(clean), "denoised.png": as_png(clean)}
    text = page(picture.title, {picture.title: shots}, caption=picture.caption, lower_is_better=())
    return {"html": text.encode(), **files}


def fit(found: MaterialFit) -> bytes:
    """The page that flips between the given image of each view and what a fit has found, exposed for the brightest."""
    scenes, given = {}, [view.given[view.counts > 0] for view in found.views]
    bright = max((float(np.percentile(pixels, 97)) for pixels in given if pixels.size), default=1.0)
    exposure = round(-math.log2(bright), 1) if bright > 0 else 0.0
    for view in found.views:
        shape = (*view.counts.shape, 3)  # one channel is grey
        given, image = (
            np.broadcast_to(np.maximum(np.nan_to_num(each), 0.0), shape) for each in (view.given, view.found)
        )
        shots = [Shot("given", given), compared("found", image, given, mask=view.counts > 0)]
        scenes[f"{view.name}, held out" if view.held_out else view.name] = shots
    notes = "FLIP and relative squared error of the pixels that count."
    caption = "; ".join([*found.lines(), *found.told])
    return page("Images and fit", scenes, exposure=exposure, caption=caption, notes=notes).encode()
