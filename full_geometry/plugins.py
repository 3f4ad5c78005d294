"""Registration of the plugins with Mitsuba, once for each variant, with what they need of the rooms above them."""

from __future__ import annotations

import importlib
import threading

import mitsuba as mi

from full_geometry.integrators.bssrdf import integrator_class
from full_geometry.integrators.translucent_walk import walk_integrator_class
from full_geometry.scenes.scene_files import apart, plainly
from full_geometry.settings import VARIANTS, Choices, Settings, variant_channels
from full_geometry.surface.sheets import sheet_class
from full_geometry.surface.translucent import translucent_class
from full_geometry.transport.models import check_model, model_names
from halfspace_sss.backend import gather_at_once, prepare_llvm, two_threads

TRADE = "full_geometry.trade.automatic"
_active = False
_lock = threading.Lock()


def register() -> None:
    """Register the plugins with the current variant of Mitsuba, and with every variant that is set later.

    What the plugins refuse is from then on the message of the error of `mitsuba.load_dict`, `load_file`, `load_string`
    and `render`, which without it begins with "unknown plugin" and a traceback. Without `optimize` the former keep
    meshes of one translucent surface apart, for `translucent_walk` and models of whole objects.

    Raises:
        ValueError: no variant is set, or the plugins do not run under it (scalar or polarised ones).
        BackendError: the LLVM that Dr.Jit found would abort the process.
    """
    global _active
    variant_channels()
    with _lock:
        _register_all()
        if not _active:
            mi.detail.add_variant_callback(_on_variant)
            for kind in ("dict", "file", "string"):
                loads = apart(getattr(mi, f"load_{kind}"), getattr(mi.parser, f"parse_{kind}"))
                setattr(mi, f"load_{kind}", plainly(loads))
            mi.render = plainly(mi.render)
            _active = True


def _on_variant(old: str, new: str) -> None:
    if new in VARIANTS:
        _register_all()


def _choose(scene: mi.Scene, settings: Settings) -> Choices:
    """What stands for the model "auto"; the trade, which measures that, is named here and imported when it is asked."""
    return importlib.import_module(TRADE).choose(scene, settings)


def _register_all() -> None:
    if mi.variant().startswith("llvm"):
        prepare_llvm()
        gather_at_once()
    two_threads()

    def check(model: str) -> None:
        check_model(model, model_names())

    def surface(props: mi.Properties) -> mi.BSDF:
        return sheet_class()(props) if "thickness" in props else translucent_class()(props, check)

    mi.register_bsdf("translucent", surface)
    mi.register_integrator("bssrdf", lambda props: integrator_class()(props, _choose))
    mi.register_integrator("translucent_walk", walk_integrator_class())
