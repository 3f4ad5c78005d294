"""A figure of images as papers have it: a row for each scene, a column for each model, crops and FLIP maps below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Rectangle
from matplotlib.textpath import TextPath

from figures.computing.images import FLIP, Shot, absent
from full_geometry.trade.image_differences import srgb
from halfspace_sss.comparison.style import TEXT

GAP, ROW_GAP, TITLE, CAPTION, NAME = 0.035, 0.07, 0.17, 0.13, 0.16  # inches
CROP_COLORS = ("#E69F00", "#56B4E9", "#009E73")
PALE, GREY = "#f5f5f5", "#8a8a8a"


@dataclass(frozen=True)
class Crop:
    """A part of an image, pixels: the left and upper edge, width and height."""

    x: int
    y: int
    width: int
    height: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """That part of the image."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]


def image_grid(
    scenes: Mapping[str, Sequence[Shot]], *, crops: Mapping[str, Sequence[Crop]] | None = None,
    exposures: Mapping[str, float] | None = None, printed: Sequence[str] = (FLIP,), width: float = TEXT,
) -> Figure:  # fmt: skip
    """The figure; draw it under `paper` of `halfspace_sss.comparison.style`, write it with `saved`.

    FLIP maps and numbers are drawn as they are: `compared` must have had the exposure of the scene. A model that has no
    image in a scene (`figures.computing.images.absent`, or none at all) gets a pale frame that says so.

    Args:
        scenes: name of a scene -> its images, the reference first; the columns are their labels in order.
        crops: for each scene up to three parts that are enlarged below the images.
        exposures: for each scene the stops at which it is shown; 0 where none is given, else printed with its name.
        printed: columns of `Shot.numbers` that stand below each image; the smallest of the first is bold.
        width: of the figure, inches.

    Raises:
        ValueError: there is no scene, one starts without an image, or a crop is not inside its image.
    """
    crops, exposures = crops or {}, exposures or {}
    columns = _columns(scenes, crops, exposures)
    figure, cell = Figure(), (width - NAME - GAP * (len(columns) - 1)) / len(columns)
    rows = [
        _GridRow(name, list(shots), tuple(crops.get(name, ())), exposures.get(name, 0.0), cell)
        for name, shots in scenes.items()
    ]
    height = TITLE + sum(row.height for row in rows) + ROW_GAP * (len(rows) - 1)
    figure.set_size_inches(width, height)
    page, size = _Page(figure, width, height), _title_size(columns, cell)
    for k, label in enumerate(columns):
        gone = all(_shot(row, label).image is None for row in rows)
        x = NAME + k * (cell + GAP) + cell / 2
        page.text(x, TITLE - 0.045, label, ha="center", va="bottom", fontsize=size, color=GREY if gone else "black")
    top = TITLE
    for row in rows:
        _draw_row(page, row, columns, top, printed)
        top += row.height + ROW_GAP
    return figure


@dataclass(frozen=True)
class _GridRow:
    """A scene, and the sizes of what is drawn of it in a cell of given width, inches."""

    name: str
    shots: list[Shot]
    crops: tuple[Crop, ...]
    exposure: float
    cell: float

    @property
    def image_height(self) -> float:
        height, width = self.shots[0].image.shape[:2]
        return self.cell * height / width

    @property
    def slots(self) -> int:
        """Pictures side by side below the image: crops and FLIP map."""
        return len(self.crops) + any(shot.flip is not None for shot in self.shots)

    @property
    def slot_width(self) -> float:
        return (self.cell - GAP / 2 * (self.slots - 1)) / self.slots

    @property
    def strip_height(self) -> float:
        return self.slot_width * self.image_height / self.cell if self.slots else 0.0

    @property
    def pictures_height(self) -> float:
        return self.image_height + (GAP / 2 + self.strip_height if self.slots else 0.0)

    @property
    def height(self) -> float:
        return self.pictures_height + CAPTION


class _Page:
    """A figure in inches from its upper left corner."""

    def __init__(self, figure: Figure, width: float, height: float) -> None:
        self.figure, self.width, self.height = figure, width, height

    def axes(self, x: float, y: float, width: float, height: float) -> Axes:
        box = (x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height)
        ax = self.figure.add_axes(box)
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        return ax

    def text(self, x: float, y: float, text: str, **style: object) -> None:
        self.figure.text(x / self.width, 1 - y / self.height, text, **style)


def _columns(
    scenes: Mapping[str, Sequence[Shot]], crops: Mapping[str, Sequence[Crop]], exposures: Mapping[str, float]
) -> list[str]:
    if not scenes:
        raise ValueError("scenes must hold at least one scene, got none")
    for what, given in (("crops", crops), ("exposures", exposures)):
        if unknown := [name for name in given if name not in scenes]:
            raise ValueError(f"{what} must be of the scenes {', '.join(scenes)}, got {unknown[0]!r}")
    for name, shots in scenes.items():
        if not shots or shots[0].image is None:
            raise ValueError(f"scene {name!r} must start with the image of its reference, got none")
        height, width = shots[0].image.shape[:2]
        if len(crops.get(name, ())) > len(CROP_COLORS):
            raise ValueError(f"crops of {name!r} must be {len(CROP_COLORS)} at most, got {len(crops[name])}")
        for c in crops.get(name, ()):
            if not (0 <= c.x < c.x + c.width <= width and 0 <= c.y < c.y + c.height <= height):
                raise ValueError(f"crops of {name!r} must lie inside {width} x {height} pixels, got {c}")
    return list(dict.fromkeys(shot.label for shots in scenes.values() for shot in shots))


def _shot(row: _GridRow, label: str) -> Shot:
    return next((shot for shot in row.shots if shot.label == label), absent(label))


def _draw_row(page: _Page, row: _GridRow, columns: Sequence[str], top: float, printed: Sequence[str]) -> None:
    name = row.name + (f" ({row.exposure:+g} stops)" if row.exposure else "")
    page.text(NAME - 0.05, top + row.pictures_height / 2, name, rotation=90, ha="right", va="center")
    numbers = [shot.numbers[printed[0]] for shot in row.shots if printed and printed[0] in shot.numbers]
    best = min((v for v in numbers if not isinstance(v, str)), default=None)
    for k, label in enumerate(columns):
        shot, x = _shot(row, label), NAME + k * (row.cell + GAP)
        if shot.image is None:
            _draw_absent(page.axes(x, top, row.cell, row.pictures_height), shot.why)
            continue
        _draw_image(page.axes(x, top, row.cell, row.image_height), row, shot.image)
        _draw_strip(page, row, shot, x, top + row.image_height + GAP / 2)
        text = "   ".join(_said(column, shot.numbers[column]) for column in printed if column in shot.numbers)
        weight = "bold" if printed and best is not None and shot.numbers.get(printed[0]) == best else "normal"
        below = top + row.pictures_height + 0.02
        size = 6.5 * min(1.0, 72 * row.cell / max(_text_width(text, 6.5, weight), 1e-6))
        page.text(x + row.cell / 2, below, text, ha="center", va="top", fontsize=size, fontweight=weight)


def _draw_absent(ax: Axes, why: str) -> None:
    ax.set_facecolor(PALE)
    ax.spines[:].set(visible=True, color=GREY, linewidth=0.4, linestyle=(0, (4, 3)))
    ax.text(
        0.5,
        0.5,
        why,
        transform=ax.transAxes,
        ha="center",
        va="center",
        color=GREY,
        fontsize=6.5,
        style="italic",
        wrap=True,
    )


def _draw_image(ax: Axes, row: _GridRow, image: np.ndarray) -> None:
    ax.imshow(srgb(image, row.exposure), aspect="auto")
    for crop, color in zip(row.crops, CROP_COLORS):
        frame = (crop.x - 0.5, crop.y - 0.5), crop.width, crop.height
        ax.add_patch(Rectangle(*frame, fill=False, edgecolor=color, linewidth=0.7))


def _draw_strip(page: _Page, row: _GridRow, shot: Shot, x: float, top: float) -> None:
    """The crops, and the FLIP map or, for a reference, the scale of the maps."""
    step = row.slot_width + GAP / 2 if row.slots else 0.0
    for k, (crop, color) in enumerate(zip(row.crops, CROP_COLORS)):
        ax = page.axes(x + k * step, top, row.slot_width, row.strip_height)
        _draw_crop(ax, srgb(crop.of(shot.image), row.exposure), color, row.slot_width / row.strip_height)
    if row.slots == len(row.crops):
        return
    left = x + len(row.crops) * step
    if shot.flip is not None:
        page.axes(left, top, row.slot_width, row.strip_height).imshow(
            shot.flip, cmap="magma", vmin=0, vmax=1, aspect="auto"
        )
        return
    bar = page.axes(left + 0.02, top + row.strip_height - 0.09, row.slot_width - 0.04, 0.05)
    scale = page.figure.colorbar(ScalarMappable(Normalize(0, 1), colormaps["magma"]), cax=bar, orientation="horizontal")
    scale.outline.set_linewidth(0.3)
    scale.set_ticks([])
    bar.text(0, 1.25, "0", transform=bar.transAxes, ha="left", fontsize=5.5)
    bar.text(0.5, 1.25, "FLIP", transform=bar.transAxes, ha="center", fontsize=5.5)
    bar.text(1, 1.25, "1", transform=bar.transAxes, ha="right", fontsize=5.5)


def _draw_crop(ax: Axes, pixels: np.ndarray, color: str, aspect: float) -> None:
    """The crop in a frame of its colour, as large as it fits, its pixels as squares."""
    height, width = pixels.shape[:2]
    ax.imshow(pixels, interpolation="nearest", aspect="equal" if abs(width / height / aspect - 1) > 0.02 else "auto")
    ax.spines[:].set(visible=True, color=color, linewidth=0.8)


def _said(column: str, value: float | str) -> str:
    """ "FLIP 0.0830"; the unit of a column such as "time, s" comes after its number."""
    name, _, unit = column.partition(", ")
    if not isinstance(value, str):
        value = f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:#.3g}"
    return f"{name} {value} {unit}".strip()


def _title_size(labels: Sequence[str], cell: float) -> float:
    """The size of type, points, at which the widest title fits above its column."""
    size = mpl.rcParams["axes.titlesize"]
    size = size if isinstance(size, float | int) else mpl.rcParams["font.size"]
    widest = max(_text_width(label, size) for label in labels)
    return size * min(1.0, 72 * cell / max(widest, 1e-6))


def _text_width(text: str, size: float, weight: str = "normal") -> float:
    """Points that a line of the figure's type takes."""
    return TextPath((0, 0), text, prop=FontProperties(size=size, weight=weight)).get_extents().width if text else 0.0
