"""What a model of objects says of itself, and what stands for the model "auto"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

AUTO = "auto"  # the cheapest model that keeps the tolerance, see `trade.automatic`
PATH_TRACED = "path_traced"  # stands for walks by `translucent_walk` where a model is named


@dataclass(frozen=True)
class Capabilities:
    """What a model takes. Where an object has what its model does not take, the scene is refused.

    Args:
        of_half_space: S is that of a plane, at the distance of two points; else that of the object in its own frame.
        orders: of scattering that S contains, "multiple" (two and more) or "total"; of a half-space model its class
            says so.
        straight: light that passes the object unscattered is traced beside S. A model that lacks it and has no orders
            of its own from two on is refused where that light is more than a quarter.
        textures: media by textures.
        spectra: spectral variants of Mitsuba.
        inclusions: objects with something inside.
        varying: media that vary in space, "exact", by their "mean", or "" where they are refused.
        stretched: instances that are stretched, beside those that are moved, turned or mirrored.
        normal_maps: normal and bump maps around the surface.
        gathered: light that is gathered once changes it; where it does not, images are those of sampled light.
        derivatives: name of the half-space model that knows the same media, for derivatives by the medium; "" where
            there are none.
        trained: each object has to be trained before.
    """

    of_half_space: bool = False
    orders: str = "multiple"
    straight: bool = False
    textures: bool = False
    spectra: bool = False
    inclusions: bool = False
    varying: str = ""
    stretched: bool = False
    normal_maps: bool = False
    gathered: bool = False
    derivatives: str = ""
    trained: bool = False


class Choices(NamedTuple):
    """What stands for "auto" in a scene.

    Args:
        models: by number among the translucent objects of the scene, of those whose model is "auto".
        light: "sampled" or "gathered".
        sentences: why, by id of the object.
    """

    models: dict[int, str]
    light: str
    sentences: dict[str, str]
