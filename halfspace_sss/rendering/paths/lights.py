"""What kinds of emitters a scene has, and so how directions of incidence are sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from halfspace_sss.rendering.light.small import is_delta

__all__ = ["Lights", "balance"]

EMITTER_SHARE = 0.5


@dataclass(frozen=True)
class Lights:
    """Kinds of emitters.

    Args:
        share: share of the directions into an object that are sampled by emitters; 0 where all light is the same from
            everywhere, which the model's own directions find better.
        some_local: whether there is an emitter beside the environment.
        some_shaped: whether there is one with a shape, which rays can hit.
        some_delta: whether there is one that no ray can hit (point, spot, directional).
    """

    share: float
    some_local: bool
    some_shaped: bool
    some_delta: bool

    @classmethod
    def of(cls, scene: Any) -> Lights:
        """The lights of a scene."""
        emitters = scene.emitters()
        even = all("Constant" in emitter.class_name() for emitter in emitters)
        delta = any(map(is_delta, emitters))
        local = any(not emitter.is_environment() for emitter in emitters)
        shaped = any(emitter.get_shape() is not None for emitter in emitters)
        return cls(0.0 if even else EMITTER_SHARE, local, shaped, delta)


def balance(pdf: Any, other: Any) -> Any:
    """The balance heuristic."""
    total = pdf + other
    return dr.select(total > 0, pdf / dr.maximum(total, 1e-30), 0)
