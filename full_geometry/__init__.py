"""Subsurface scattering on meshes, for Mitsuba 3: path tracing, BSSRDF models laid onto surfaces, and learnt transport.

    import full_geometry, mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()                # once; later calls of mi.set_variant are followed

`register` adds three plugins: the BSDF `translucent` (medium, model and scattering orders of an object) and the
integrators `bssrdf` and `translucent_walk`. `train` learns S of one object, `errors` says how wrong a model of it is.
`inverse` fits media to images; `trade` measures what each way of rendering costs and how wrong it is; `frames` renders
animations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from full_geometry import inverse, trade
    from full_geometry.learning.model_errors import errors, object_of, transport_of
    from full_geometry.learning.network_fitting import Recipe
    from full_geometry.learning.training import train
    from full_geometry.plugins import register
    from full_geometry.transport.storing import load
    from full_geometry.viewing.frames import frames
    from full_geometry.viewing.page import view

__all__ = [
    "Recipe", "errors", "frames", "inverse", "load", "object_of", "register", "trade", "train", "transport_of", "view",
]  # fmt: skip
__getattr__, __dir__ = lazy_names(__name__, {
    "": ["inverse", "trade"], "learning.model_errors": ["errors", "object_of", "transport_of"], "plugins": ["register"],
    "learning.network_fitting": ["Recipe"], "learning.training": ["train"], "transport.storing": ["load"],
    "viewing.frames": ["frames"], "viewing.page": ["view"],
})  # fmt: skip
