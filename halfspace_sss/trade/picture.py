"""What the figure of a trade is drawn from: an entry point "trade" of `halfspace_sss.figures` takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from halfspace_sss.trade.advice import Advice
from halfspace_sss.trade.images import small_images
from halfspace_sss.trade.measuring.results import Assessment
from halfspace_sss.trade.measuring.ways import Way, stage

__all__ = ["TradePicture", "picture_of"]

SIDE, SPP = 128, 32  # of the images of the page


@dataclass(frozen=True, eq=False)
class TradePicture:
    """A trade to be drawn.

    Args:
        title: of the scene.
        found: what was measured.
        tolerance: that was asked.
        sentences: of the recommendation.
        images: linear radiance (H, W, 3) by name of the way, path traced first.
    """

    title: str
    found: Assessment
    tolerance: float
    sentences: tuple[str, ...] = ()
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


def picture_of(file: Path, advice: Advice, how: Mapping[str, Any]) -> TradePicture:
    """The picture of a recommendation for a scene file, whose images are rendered for it.

    Args:
        file: the scene.
        advice: for it.
        how: sensor, seed and parameters, as for `assess`.
    """
    found = advice.assessment
    names = dict.fromkeys(w.way for o in found.objects for w in o.ways if not w.refusal)
    images: Mapping[str, np.ndarray] = {}
    if names:
        on = stage(file, how["parameters"])
        images = small_images(on, [Way.of(name) for name in names], how["sensor"], how["seed"], SIDE, SPP)
    return TradePicture(file.stem, found, advice.tolerance, tuple(str(advice).splitlines()), images)
