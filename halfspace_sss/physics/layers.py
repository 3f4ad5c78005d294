"""Media in layers below the plane, parallel to it."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass

from halfspace_sss.physics.medium import Medium, check_scalar_medium, medium_of


@dataclass(frozen=True)
class Layers:
    """Homogeneous media in layers parallel to the plane z = 0, the first on top.

    Args:
        media: scalar media (or materials with one channel); the eta of each is its index over that above the plane,
            at least 1, so that the step from layer k to the next is eta_{k+1} / eta_k. A clear one has sigma_s = 1e-9.
        thickness: of each layer in mm, > 0. With one number fewer than media the last layer is semi-infinite; with as
            many the stack is a slab.
        eta_below: index below a slab over that above the plane, > 0.

    Raises:
        ValueError: no layer, a coloured medium, an index below 1, a thickness that is not finite and > 0, another
            number of thicknesses, or `eta_below` without a slab.
    """

    media: Sequence[Medium]
    thickness: Sequence[float] = ()
    eta_below: float = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.media, Medium) or not isinstance(self.media, Sequence) or not self.media:
            raise ValueError(f"media must be a list of one medium or more, got {self.media!r}")
        media = []
        for k, given in enumerate(self.media, 1):
            try:
                media.append(medium := medium_of(given))
                check_scalar_medium(medium)
            except ValueError as error:
                raise ValueError(f"layer {k}: {error}") from None
            if medium.eta < 1:
                raise ValueError(f"layer {k}: eta must be >= 1, got {medium.eta!r}")
        thickness = self._checked_thickness(len(media))
        if not (_is_number(self.eta_below) and 0 < self.eta_below < math.inf):
            raise ValueError(f"eta_below must be finite and > 0, got {self.eta_below!r}")
        if self.eta_below != 1 and len(thickness) < len(media):
            raise ValueError(f"eta_below must be left out below a semi-infinite layer, got {self.eta_below!r}")
        object.__setattr__(self, "media", tuple(media))
        object.__setattr__(self, "thickness", thickness)

    def _checked_thickness(self, layers: int) -> tuple[float, ...]:
        given = self.thickness
        if _is_number(given):
            given = (given,)
        if isinstance(given, str) or not all(_is_number(d) for d in given):
            raise ValueError(f"thickness must be numbers in mm, got {given!r}")
        if len(given) not in (layers - 1, layers):
            allowed = f"{layers - 1} (the last layer semi-infinite) or {layers} (a slab)"
            raise ValueError(f"thickness must have {allowed} numbers for {layers} media, got {len(given)}")
        for k, d in enumerate(given, 1):
            if not 0 < d < math.inf:
                raise ValueError(f"thickness of layer {k} must be finite and > 0 (mm), got {d!r}")
        return tuple(float(d) for d in given)

    def __len__(self) -> int:
        return len(self.media)

    @property
    def eta(self) -> float:
        """Index of the first layer over that above the plane."""
        return self.media[0].eta

    @property
    def is_slab(self) -> bool:
        """Whether the last layer ends."""
        return len(self.thickness) == len(self.media)


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
