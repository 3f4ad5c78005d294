"""What one who looks at a live scene sees: images of what is wished for, one pass at a time, in words and bytes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from full_geometry.settings import PATH_TRACED
from full_geometry.trade.image_differences import flip_ldr, srgb
from full_geometry.viewing.edits import Camera, Edits, Way
from full_geometry.viewing.live import LiveScene, Shown
from halfspace_sss.interrupts import cancellable


class Wish(NamedTuple):
    """What is to be seen: the scene, how it is rendered and from where, stops of exposure, and a reference beside,
    on the right of a share of the width."""

    edits: Edits
    way: Way
    camera: Camera
    exposure: float = 0.0
    compare: bool = False
    split: float = 0.5


class Screen:
    """Renders a wish in passes and begins anew when it changes."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._wish: Wish | None = None
        self._runs: list[Iterator[Shown]] = []
        self._shown: list[Shown | None] = []

    def step(
        self, live: LiveScene, wish: Wish, outdated: Callable[[], bool]
    ) -> tuple[np.ndarray | None, str] | None:  # fmt: skip
        """One more pass: the picture (H, W, 3) in 8 bits and what is said of it, in Markdown; None if all is done.

        Work ends early, with None, when `outdated` says so. A scene that is refused gives no picture, but the reason.
        """
        before, self._wish = self._wish, wish
        try:
            with cancellable(outdated):
                if before is None or before[:3] != wish[:3] or before.compare != wish.compare:
                    self._runs = []
                    live.apply(wish.edits)
                    ways = [wish.way, *([Way(PATH_TRACED, "auto", wish.way.denoise)] if wish.compare else [])]
                    self._runs = [live.passes(wish.camera, way) for way in ways]
                    self._shown = [None] * len(ways)
                elif not self._runs and before == wish:
                    return None
                self._advance()
        except KeyboardInterrupt:
            self.restart()
            return None
        except (ValueError, RuntimeError, ImportError) as error:
            self._runs = []
            return None, f"**{' '.join(str(error).split())}**"
        return self._picture(wish)

    def _advance(self) -> None:
        """A pass of the image that has had less time."""
        spent = [shown.seconds if shown else -1.0 for shown in self._shown]
        for k in np.argsort(spent, kind="stable"):
            if k < len(self._runs) and (found := next(self._runs[k], None)) is not None:
                self._shown[k] = found
                return
        self._runs = []

    def _picture(self, wish: Wish) -> tuple[np.ndarray, str]:
        pictures = [srgb(np.maximum(shown.image, 0), wish.exposure) for shown in self._shown if shown]
        told = [_told(shown, "reference" if k else "") for k, shown in enumerate(self._shown) if shown]
        picture = pictures[0].copy()
        if len(pictures) > 1:
            column = round(wish.split * picture.shape[1])
            picture[:, column:] = pictures[1][:, column:]
            picture[:, column - 1 : column] = 1.0
            told.append(f"FLIP {flip_ldr(*reversed(pictures)).mean:.3f}, with the noise of both")
        return np.round(255 * picture).astype(np.uint8), "\n\n".join(told)


def _told(shown: Shown, name: str) -> str:
    """What is known of an image."""
    noise = f", noise {shown.error:.1%}" if math.isfinite(shown.error) else ""
    samples = f"{shown.spp} samples" if shown.spp else "coarse"
    time = f"{shown.seconds:.2f} s, light ready after {shown.ready:.2f} s"
    return "\n\n".join([f"{name} {samples}{noise}; {time}".strip(), *shown.told])
