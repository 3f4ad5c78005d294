"""Scenes from dicts and XML files, with model, orders and integrator replaced where asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from halfspace_sss.interface.model import models

__all__ = ["PATH_TRACED", "load_scene"]

PATH_TRACED = "path_traced"
_INTEGRATORS = {False: "bssrdf", True: "translucent_walk"}
_KEPT = ("mm_per_unit", "max_depth", "rr_depth", "hide_emitters")  # what both integrators understand


def load_scene(scene: dict | str | Path, model: str | None = None, orders: str | None = None) -> Any:
    """A Mitsuba scene with translucent objects.

    Args:
        scene: a dict as for `mitsuba.load_dict`, or the path of an XML file.
        model: for all translucent objects, instead of what the scene says: the name of a model, or "path_traced",
            which walks through the objects instead.
        orders: of all translucent objects, instead of what the scene says.

    Raises:
        ValueError: no such file, model or orders, the file is no scene, it has no translucent object, or the integrator
            refuses it.
    """
    import mitsuba as mi

    _check(model)
    state, config = _parsed(scene)
    surfaces = [node.props for node in state.nodes if node.props.plugin_name() == "translucent"]
    if not surfaces:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
    for props in surfaces:
        if model and model != PATH_TRACED:
            props["model"] = model
        if orders:
            props["orders"] = orders
    if model:
        for node in state.nodes:
            if node.props.plugin_name() in _INTEGRATORS.values():
                _set_integrator(node.props, _INTEGRATORS[model == PATH_TRACED])
    loaded = mi.parser.instantiate(config, state)
    integrator = loaded.integrator()
    if hasattr(integrator, "prepare"):
        integrator.prepare(loaded)  # here, because Mitsuba wraps what is refused while it renders
    return loaded


def _check(model: str | None) -> None:
    import difflib

    known = (*models(), PATH_TRACED)
    if model is not None and model not in known:
        close = difflib.get_close_matches(model, known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"model must be one of {', '.join(known)}, got {model!r}{hint}")


def _parsed(scene: dict | str | Path) -> tuple[Any, Any]:
    import mitsuba as mi

    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = False  # objects then have the same numbers each time, and kernels are found in Dr.Jit's cache
    if isinstance(scene, dict):
        state = mi.parser.parse_dict(config, scene)
    else:
        if not Path(scene).is_file():
            raise ValueError(f"scene must be an XML file, got {str(scene)!r}, which is none")
        try:
            state = mi.parser.parse_file(config, str(scene))
        except RuntimeError as error:
            raise ValueError(f"scene {str(scene)!r} cannot be read: {error}") from error
    mi.parser.transform_all(config, state)
    return state, config


def _set_integrator(props: Any, plugin: str) -> None:
    if props.plugin_name() == plugin:
        return
    props.set_plugin_name(plugin)
    for key in list(props.keys()):
        if key not in _KEPT:
            props.remove_property(key)
