"""A figure of images as papers have it, a row for each scene, a column for each model, FLIP maps below; its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib as mpl
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from figures.computing.contenders import WALK
from figures.computing.images import FLIP, Shot, absent
from figures.drawing.page import check_scenes, page
from figures.parts.part import Row
from full_geometry.trade.image_differences import srgb
from halfspace_sss.comparison.style import TEXT, look, paper, saved

GAP, ROW_GAP, TITLE, CAPTION, NAME = 0.035, 0.07, 0.17, 0.13, 0.16  # inches
PALE, GREY = "#f5f5f5", "#8a8a8a"


def image_grid(scenes: Mapping[str, Sequence[Shot]], printed: Sequence[str] = (FLIP,)) -> Figure:
    """The figure; draw it under `paper` of `halfspace_sss.comparison.style`, write it with `saved`.

    FLIP maps and numbers are drawn as they are: `compared` must have had the exposure of the scene. A model that has no
    image in a scene (`figures.computing.images.absent`, or none at all) gets a pale frame that says so.

    Args:
        scenes: name of a scene -> its images, the reference first; the columns are their labels in order.
        printed: columns of `Shot.numbers` that stand below each image; the smallest of the first is bold.

    Raises:
        ValueError: there is no scene, or one starts without an image.
    """
    check_scenes(scenes)
    columns = list(dict.fromkeys(shot.label for shots in scenes.values() for shot in shots))
    figure, cell, rows = Figure(), (TEXT - NAME - GAP * (len(columns) - 1)) / len(columns), []
    for name, shots in scenes.items():
        image = cell * shots[0].image.shape[0] / shots[0].image.shape[1]
        pictures = image + (GAP / 2 + image if any(s.flip is not None for s in shots) else 0.0)
        rows.append(_GridRow(name, {shot.label: shot for shot in shots}, cell, image, pictures))
    height = TITLE + sum(row.pictures + CAPTION for row in rows) + ROW_GAP * (len(rows) - 1)
    figure.set_size_inches(TEXT, height)
    page, size = _Page(figure, TEXT, height), _title_size(columns, cell)
    for k, label in enumerate(columns):
        gone = all(label not in row.shots or row.shots[label].image is None for row in rows)
        x = NAME + k * (cell + GAP) + cell / 2
        page.text(x, TITLE - 0.045, label, ha="center", va="bottom", fontsize=size, color=GREY if gone else "black")
    top = TITLE
    for row in rows:
        _draw_row(page, row, columns, top, printed)
        top += row.pictures + CAPTION + ROW_GAP
    return figure


class _GridRow(NamedTuple):
    """A scene, its shots by label, the width of a cell, and the heights of an image and of it with its map, inches."""

    name: str
    shots: dict[str, Shot]
    cell: float
    image: float
    pictures: float


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


def _draw_row(page: _Page, row: _GridRow, columns: Sequence[str], top: float, printed: Sequence[str]) -> None:
    page.text(NAME - 0.05, top + row.pictures / 2, row.name, rotation=90, ha="right", va="center")
    numbers = [shot.numbers[printed[0]] for shot in row.shots.values() if printed and printed[0] in shot.numbers]
    best = min((v for v in numbers if not isinstance(v, str)), default=None)
    for k, label in enumerate(columns):
        shot, x = row.shots.get(label, absent(label)), NAME + k * (row.cell + GAP)
        if shot.image is None:
            _draw_absent(page.axes(x, top, row.cell, row.pictures), shot.why)
            continue
        page.axes(x, top, row.cell, row.image).imshow(srgb(shot.image), aspect="auto")
        if row.pictures > row.image:
            _draw_map(page, row, shot, x, top + row.image + GAP / 2)
        text = "   ".join(_said(column, shot.numbers[column]) for column in printed if column in shot.numbers)
        weight = "bold" if printed and best is not None and shot.numbers.get(printed[0]) == best else "normal"
        below = top + row.pictures + 0.02
        size = 6.5 * min(1.0, 72 * row.cell / max(_text_width(text, 6.5, weight), 1e-6))
        page.text(x + row.cell / 2, below, text, ha="center", va="top", fontsize=size, fontweight=weight)


def _draw_absent(ax: Axes, why: str) -> None:
    ax.set_facecolor(PALE)
    ax.spines[:].set(visible=True, color=GREY, linewidth=0.4, linestyle=(0, (4, 3)))
    style = {"ha": "center", "va": "center", "color": GREY, "fontsize": 6.5, "style": "italic", "wrap": True}
    ax.text(0.5, 0.5, why, transform=ax.transAxes, **style)


def _draw_map(page: _Page, row: _GridRow, shot: Shot, left: float, top: float) -> None:
    """The FLIP map or, for a reference, the scale of the maps."""
    if shot.flip is not None:
        ax = page.axes(left, top, row.cell, row.image)
        ax.imshow(shot.flip, cmap="magma", vmin=0, vmax=1, aspect="auto")
        return
    bar = page.axes(left + 0.02, top + row.image - 0.09, row.cell - 0.04, 0.05)
    scale = page.figure.colorbar(ScalarMappable(Normalize(0, 1), colormaps["magma"]), cax=bar, orientation="horizontal")
    scale.outline.set_linewidth(0.3)
    scale.set_ticks([])
    for x, text, side in ((0, "0", "left"), (0.5, "FLIP", "center"), (1, "1", "right")):
        bar.text(x, 1.25, text, transform=bar.transAxes, ha=side, fontsize=5.5)


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


# ---- Files ----


def image_files(
    figure: str,
    title: str,
    scenes: Mapping[str, Sequence[Shot]],
    rows: Sequence[Row],
    notes: str,
    printed: Sequence[str] = (FLIP,),
) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table.

    Args:
        figure: its name.
        title: of the page.
        scenes: images of each scene, the reference first.
        rows: of the table.
        notes: below the images of the page.
        printed: numbers below each image of the picture.
    """
    import pandas

    with paper():
        drawn = saved(image_grid(scenes, printed=printed))
    files: dict[str, bytes | str] = {f"{figure}.{end}": data for end, data in drawn.items()}
    files[f"{figure}.csv"] = pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    files[f"{figure}.html"] = page(title, scenes, notes=notes)
    return files


def label(method: str) -> str:
    """The name of a method as people read it."""
    if method == WALK:
        return "Our walk"
    return "Neural half-space" if method == "neural" else look(method).label


def rows_of(scenes: Mapping[str, Sequence[Shot]], key: str) -> list[Row]:
    """Rows of the table of a figure: the numbers of each image but the references; `key` is what a scene is called."""
    return [{key: name, "model": shot.label, **shot.numbers} for name, shots in scenes.items() for shot in shots[1:]]
