"""The files of a figure of images, names of methods in them, and the images of a thing against those of walks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from figures.computing.contenders import VOLUMES, WALK
from figures.computing.images import FLIP, Shot
from figures.computing.references import against, reference_shot
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.parts.part import Result, Row
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


def against_walks(results: Mapping[str, Result], name: str, models: Iterable[str]) -> list[Shot]:
    """The images of a thing, exposed alike; with the mean of each over that of the walks."""
    reference = reference_shot(results[f"{name}, path traced"])
    shot, mask, stops = reference
    shots = [shot]
    for model in models:
        image = results[f"{name}, {model}"].images["image"]
        mean = float(np.float32(2.0**stops) * image[mask].mean() / shot.image[mask].mean())
        shots.append(against(reference, label(model), image, **{"mean over path traced": mean}))
    return shots
