"""The files of a figure of images, and names of methods in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from figures.computing.contenders import VOLUMES, WALK
from figures.computing.images import FLIP, Shot
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.parts.part import Row
from halfspace_sss.comparison.style import look, paper, saved


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
    if method in VOLUMES:
        kind, rr_depth = method.split()
        return f"Mitsuba {kind}, roulette from {rr_depth}"
    if method == WALK:
        return "Our walk"
    return "Neural half-space" if method == "neural" else look(method).label


def rows_of(scenes: Mapping[str, Sequence[Shot]], key: str) -> list[Row]:
    """Rows of the table of a figure: the numbers of each image but the references; `key` is what a scene is called."""
    return [{key: name, "model": shot.label, **shot.numbers} for name, shots in scenes.items() for shot in shots[1:]]
