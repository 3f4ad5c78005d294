"""What is written down along a path: its light, or, when it is gone through again, what derivatives its light has.

Derivatives come by replay (Vicini, Speierer and Jakob 2021): a path is traced, then traced again with the same random
numbers. There the light that is still to come is known at every vertex, so each factor is differentiated on its own,
the others held, and no loop is recorded. Where paths go, and with what density, is not differentiated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

__all__ = ["Books", "Replay", "Tally"]

Books = tuple[Any, Any]  # radiance so far, or in a replay still to come; its derivative, or adjoint; spectra


@dataclass(frozen=True)
class Tally:
    """Adds up the light of a path."""

    tracks = False

    def add(self, books: Books, light: Any) -> Books:
        """Light that the path brings."""
        return books[0] + light, books[1]

    def settle(self, books: Books, light: Any, weight: Any, goes_on: Any, shown: Any) -> Books:
        """A vertex: its light, and the weight of what comes after it where the path goes on.

        Args:
            light: spectrum, to be added.
            weight: spectrum that scales all light after the vertex.
            goes_on: where it does.
            shown: light that the weight scales too, over the weight, and that is in the books already.
        """
        return self.add(books, light)


@dataclass(frozen=True)
class Replay:
    """Takes the light of a path away again, and differentiates it.

    Args:
        backward: whether derivatives of light are handed to the parameters, or those of the parameters to the light.
    """

    backward: bool
    tracks = True

    def add(self, books: Books, light: Any) -> Books:
        """Light that the path brings."""
        L, d = self._vary(books, light)
        return L - dr.detach(light), d

    def settle(self, books: Books, light: Any, weight: Any, goes_on: Any, shown: Any) -> Books:
        """As in `Tally`."""
        L = books[0] - dr.detach(light)
        fixed = dr.detach(weight)
        after = dr.select(goes_on & (fixed != 0), L / dr.select(fixed != 0, fixed, 1), 0)
        return self._vary((L, books[1]), light + weight * (after + shown))

    def _vary(self, books: Books, value: Any) -> Books:
        L, d = books
        if not dr.grad_enabled(value):
            return books
        if self.backward:
            dr.backward_from(d * value)
            return books
        return L, d + dr.forward_to(value)
