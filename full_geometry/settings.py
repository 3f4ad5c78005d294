"""Settings of the integrators, checked before a scene is touched, and what models of objects take."""

from __future__ import annotations

import functools
import numbers
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from halfspace_sss.checks import check_choice, check_count, check_flag, check_interval

if TYPE_CHECKING:
    import mitsuba as mi

AUTOMATIC = -1.0
MM_PER_UNIT = (1e-9, 1e9)
ORDERS = ("total", "multiple", "single")
LIGHTS = ("sampled", "gathered", "corrected", "auto")
GATHERED_LIGHTS = ("gathered", "corrected")  # found once, before the first sample
WALK_LIGHTS = ("auto", "precomputed", "sampled")  # of `translucent_walk`
LAYER = ["emission.R", "emission.G", "emission.B"]  # channels of emission that the camera sees
SHARED = ("mm_per_unit", "max_depth", "rr_depth", "hide_emitters")  # what `translucent_walk` understands too
OF_MODELS = ("area_share", "entries")


@dataclass(frozen=True)
class Settings:
    """Parameters of the integrator `bssrdf`.

    Args:
        mm_per_unit: millimetres in one unit of the scene.
        max_depth: vertices of a path after the camera, an entry and its exit counting as one; -1 for no limit.
        rr_depth: vertices after which Russian roulette begins.
        area_share: share of the candidates for an entry that are drawn uniformly over the area, the others by a probe
            near the exit, 0 to 1; AUTOMATIC chooses by the ratio of the distance that light travels to the size of the
            object.
        entries: points of entry that an exit draws; one is followed, chosen by what it may bring; AUTOMATIC
            leaves it to the model.
        light: "sampled", without bias beside that of the model; "gathered" once for all samples, see
            `integrators.gathering`: scattered light has no noise, and a little more bias; "corrected", gathered and
            then corrected by random walks, see `integrators.correction`; or "auto", the cheapest of these that keeps
            the tolerance, by measurement.
        hide_emitters: whether directly visible emitters are left out.
        tolerance: relative error of the radiance of an object that its model "auto" keeps; see `trade.automatic`.
        layers: whether images have the layer `emission`, what the camera sees of emitters, at once or in the mirror of
            an object; of light that is "corrected" alone.
        model, orders: of all objects, instead of what their surfaces say, where they are given.
    """

    mm_per_unit: float = 1.0
    max_depth: int = -1
    rr_depth: int = 5
    area_share: float = AUTOMATIC
    entries: int = int(AUTOMATIC)
    hide_emitters: bool = False
    light: str = "sampled"
    tolerance: float = 0.05
    layers: bool = False
    model: str = ""
    orders: str = ""

    def __post_init__(self) -> None:
        check_interval("mm_per_unit", self.mm_per_unit, *MM_PER_UNIT)
        check_interval("tolerance", self.tolerance, 1e-4, 10.0)
        check_depth("max_depth", self.max_depth)
        check_count("rr_depth", self.rr_depth, 1)
        check_depth("entries", self.entries)
        check_choice("light", self.light, LIGHTS)
        check_choice("orders", self.orders, ("", *ORDERS))
        check_flag("layers", self.layers)
        if self.layers and self.light != "corrected":
            raise ValueError(f"layers must be false where light is not corrected, got true with {self.light}")
        if self.area_share != AUTOMATIC:
            check_interval("area_share", self.area_share, 0.0, 1.0)

    def shared(self) -> dict[str, Any]:
        """The settings that `translucent_walk` understands too."""
        return {name: getattr(self, name) for name in SHARED}

    def of_models(self) -> dict[str, Any]:
        """How models are laid on and sampled; what is automatic is left to them."""
        given = {name: getattr(self, name) for name in OF_MODELS}
        given = {name: value for name, value in given.items() if value != AUTOMATIC}
        return given | ({"orders": self.orders} if self.orders else {})


def check_depth(name: str, value: object) -> None:
    """ValueError unless a value is a count, or -1 for none."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < -1 or value == 0:
        raise ValueError(f"{name} must be -1 or a whole number >= 1, got {value!r}")


def read_settings(props: mi.Properties) -> Settings:
    """Settings from the parameters of the plugin; ValueError if one is unknown or out of range."""
    check_parameters("bssrdf", props, (*Settings.__dataclass_fields__, *OF_MITSUBA))
    given = {key: props[key] for key in Settings.__dataclass_fields__ if key in props}
    return Settings(**given)


# --------------------------------------------------------------------------------------------------
# The variants of Mitsuba under which the plugins run.


CHANNELS = {"rgb": 3, "mono": 1, "spectral": 4}
VARIANTS = tuple(f"{backend}_ad_{kind}" for kind in CHANNELS for backend in ("llvm", "cuda"))


def variant_channels() -> int:
    """3 under an RGB variant of Mitsuba, 1 under a mono one, 4 wavelengths under a spectral one.

    Raises:
        ValueError: no variant is set, or another kind is.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant not in VARIANTS:
        raise ValueError(f"variant must be llvm_ad_ or cuda_ad_ with rgb, mono or spectral, got {variant!r}")
    return CHANNELS[variant.rpartition("_")[2]]


R = TypeVar("R")


def per_variant(make: Callable[[], R]) -> Callable[[], R]:
    """What `make` makes under the current variant of Mitsuba, such as a class of a plugin; once for each variant."""
    made = functools.cache(lambda variant: make())

    @functools.wraps(make)
    def current() -> R:
        import mitsuba as mi

        return made(mi.variant())

    return current


def check_variant() -> None:
    """ValueError if no variant of Mitsuba is set, before anything of Mitsuba is asked that would then not be there."""
    import mitsuba as mi

    if mi.variant() is None:
        raise ValueError(
            "a variant of Mitsuba must be set before a scene is looked at, got none: "
            "`mitsuba.set_variant('llvm_ad_rgb')`, then `full_geometry.register()`"
        )


# --------------------------------------------------------------------------------------------------
# The names of parameters that plugins take: one that none takes is refused.


OF_MITSUBA = ("block_size", "samples_per_pass", "timeout")  # of its `SamplingIntegrator`; launches are ours


def check_parameters(plugin: str, props: mi.Properties, known: Collection[str]) -> None:
    """ValueError names the first parameter of a plugin that it does not know."""
    for key in props.keys():
        check_choice(f"parameter of {plugin}", key, known)


# --------------------------------------------------------------------------------------------------
# What a model of objects says of itself, and what stands for the model "auto".


AUTO = "auto"  # the cheapest model that keeps the tolerance, see `trade.automatic`
NO_OBJECT = (
    "the scene must have an object with a translucent BSDF, got none; surfaces with a thickness alone are rendered by "
    "Mitsuba's path"
)
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
        light: of models, "sampled", "gathered" or "corrected".
        sentences: why, by id of the object.
    """

    models: dict[int, str]
    light: str
    sentences: dict[str, str]
