"""Scenes from dicts and XML files, with model, orders and integrator replaced where asked for, and edited later.

What Mitsuba raises is brought down to its first cause: errors of plugins come wrapped, with tracebacks inside.
"""

from __future__ import annotations

import functools
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import floats
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.scenes.gltf import SUFFIXES, gltf_scene, is_gltf
from full_geometry.settings import LIGHTS, NO_OBJECT, ORDERS, PATH_TRACED, SHARED, WALK_LIGHTS, check_variant
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.models import model_names, of_objects
from halfspace_sss.checks import check_choice, did_you_mean
from halfspace_sss.interrupts import is_interrupt

if TYPE_CHECKING:
    from mitsuba.parser import ParserConfig, ParserState

_HERE = str(Path(__file__).parents[2])
EXPORTABLE = (".usd", ".usda", ".usdc", ".usdz", ".blend", ".fbx", ".obj")  # files of programs that write glTF too

_PLACE = re.compile(r"(?:At|While loading) (?:dictionary node )?(.+? \(line \d+, col \d+\)|\S+): ")
_SOURCE = re.compile(r"^\[[\w.]+:\d+\] ")
_PLUGIN = re.compile(r'failed to instantiate \w+ plugin of type "[^"]*": ')
_RAISED = re.compile(r"^(?:[\w.]*\.)?(\w+): (.*)", re.MULTILINE | re.DOTALL)
_EMPTY = re.compile(r'shape plugin of type "\w+": .*operands have incompatible sizes! \(sizes: 0,')
_TRACEBACK = "Traceback (most recent call last):"


def first_cause(error: BaseException) -> str:
    """One line: where in the scene file, if that is known, and what was wrong there first."""
    error = _first(error)
    text = str(error)
    place = _PLACE.search(text)
    if _EMPTY.search(text):
        text = "a mesh must have faces, got none"
    elif _TRACEBACK in text:
        frames = text[text.rindex(_TRACEBACK) :].splitlines()[1:]
        said = next((k for k, line in enumerate(frames) if line[:1].strip()), len(frames))  # frames are indented
        raised = _RAISED.match("\n".join(frames[said:]).strip())
        text = raised[2] if raised else "\n".join(frames[said:])
    else:
        text = _PLUGIN.sub("", _PLACE.sub("", _SOURCE.sub("", text)))
        text = _SOURCE.sub("", text)
    line = " ".join(text.split()) or type(error).__name__
    return f"{place[1]}: {line}" if place and place[1] != '"root"' else line


def _first(error: BaseException) -> BaseException:
    """A refusal by this project that others have wrapped; without one, where the chain of errors began."""
    while not _is_refusal(error) and (error.__cause__ or error.__context__):
        error = error.__cause__ or error.__context__
    return error


def _is_refusal(error: BaseException) -> bool:
    """Whether it is a ValueError that was raised in a file of this project."""
    files, place = [], error.__traceback__
    while place is not None:
        files.append(place.tb_frame.f_code.co_filename)
        place = place.tb_next
    return isinstance(error, ValueError) and bool(files) and files[-1].startswith(_HERE)


class SceneError(ValueError, RuntimeError):
    """A refusal by a plugin of this project, in place of the RuntimeError that Mitsuba makes of it."""


def plainly(function: Callable) -> Callable:
    """A function of Mitsuba whose errors say first what a plugin of this project refused, as a `SceneError`.

    An interrupt that Dr.Jit has wrapped is a KeyboardInterrupt again.
    """

    @functools.wraps(function)
    def found(*args: object, **more: object) -> object:
        try:
            return function(*args, **more)
        except RuntimeError as error:
            if is_interrupt(error):
                end: BaseException = KeyboardInterrupt()
            elif _is_ours(error):
                end = SceneError(first_cause(error))
            else:
                raise
        raise end

    found.__wrapped__ = function
    return found


def _is_ours(error: BaseException) -> bool:
    """Whether a plugin of this project raised a ValueError: by the files of its traceback, or of that in the text.
    A mesh without faces counts too: what Mitsuba says of it says nothing."""
    error = _first(error)
    if isinstance(error, ValueError):
        return _is_refusal(error)
    text = str(error)
    if _EMPTY.search(text):
        return True
    return _TRACEBACK in text and "ValueError: " in text and _HERE in text[text.rindex(_TRACEBACK) :]


NO_MESHES = ("sphere", "disk", "cylinder", "sdfgrid", "bsplinecurve", "linearcurve", "instance", "shapegroup")
_INTEGRATORS = {False: "bssrdf", True: "translucent_walk"}


def load_scene(
    scene: dict[str, Any] | str | Path,
    model: str | None = None,
    orders: str | None = None,
    parameters: Mapping[str, str] | None = None,
    settings: Mapping[str, float] | None = None,
) -> mi.Scene:
    """A Mitsuba scene with translucent objects, ready to be rendered.

    Where model or orders are asked for and the integrator of the scene shows no light from inside, ours takes its
    place, with its mm_per_unit, max_depth, rr_depth and hide_emitters; a warning says so. A scene without integrator
    gets `bssrdf` where it or the caller names a model or gathered light, else `translucent_walk`, which is right for
    every object.

    Args:
        scene: a dict as for `mitsuba.load_dict`, or the path of an XML or glTF file.
        model: for all translucent objects, instead of what the scene says: the name of a model, or "path_traced",
            which walks through the objects instead.
        orders: of all translucent objects, instead of what the scene says.
        parameters: values of the parameters $name of an XML file.
        settings: parameters of the integrator, instead of what the scene says; each takes those that it knows.

    Raises:
        ValueError: no such file, parameter, model or orders, the file is no scene, a plugin refuses what it is given,
            there is no translucent object, or the integrator refuses the scene.
    """
    loaded = open_scene(scene, model, orders, parameters, settings)
    integrator = loaded.integrator()
    if is_bssrdf(integrator):
        integrator.prepare(loaded)  # here, because Mitsuba wraps what is refused while it renders
    return loaded


def open_scene(
    scene: dict[str, Any] | str | Path,
    model: str | None = None,
    orders: str | None = None,
    parameters: Mapping[str, str] | None = None,
    settings: Mapping[str, float] | None = None,
    floats: bool = False,
    change: Callable[[ParserState], None] | None = None,
) -> mi.Scene:
    """Load a scene as `load_scene` does, but make no model yet.

    With `floats`, texels of bitmaps are floats, which can be changed by any amount, whatever their files have.
    `change` may change the scene as it was parsed.
    """
    light = (settings or {}).get("light")
    walks = model == PATH_TRACED
    known = WALK_LIGHTS if walks else LIGHTS if model else tuple(dict.fromkeys((*LIGHTS, *WALK_LIGHTS)))
    asked = ("model", model, (*model_names(), PATH_TRACED)), ("orders", orders, ORDERS), ("light", light, known)
    for name, value, choices in asked:
        if value is not None:
            check_choice(name, value, choices)
    state, config = parsed(scene, parameters or {})
    if change is not None:
        change(state)
    names = [str(props.get("model", "")) for props in _surfaces(state)]
    _transform(scene, state, config, apart=walks or _apart(state, model))
    for props in _surfaces(state):  # anew: the nodes have moved
        if "thickness" in props:  # thin walls have neither
            continue
        if model and not walks:
            props["model"] = model
        if orders:
            props["orders"] = orders
    named = model not in (None, PATH_TRACED) or any(names) or (light is not None and light not in WALK_LIGHTS)
    own = is_gltf(scene)  # its integrator is there for its unit alone
    by_walks, asked = walks or (own and not named), (bool(model) or own, bool(model or orders) or own)
    _choose_integrator(state, by_walks, not named, asked, settings or {})
    for plugin, given in zip(_INTEGRATORS.values(), _settings(settings or {})):
        _set_parameters(state, plugin, given)
    layered = {"layers": True} if (settings or {}).get("layers") else {}
    _set_parameters(state, "bssrdf", layered, lambda props: props.get("light") == "corrected")
    _set_parameters(state, "bitmap", {"format": "variant"} if floats else {})
    loaded = _made(scene, state, config)
    if not any(map(surface_of, loaded.shapes())):
        raise ValueError(NO_OBJECT)
    return loaded


def names_nothing(scene: dict[str, Any] | str | Path, parameters: Mapping[str, str] | None = None) -> bool:
    """Whether a scene has no integrator and names no model, so that what renders it is left to us."""
    state, _ = parsed(scene, parameters or {})
    integrators = any(node.type == mi.ObjectType.Integrator for node in state.nodes)
    return (is_gltf(scene) or not integrators) and not any("model" in props for props in _surfaces(state))


def _set_parameters(
    state: ParserState, plugin: str, settings: Mapping[str, float | str],
    some: Callable[[mi.Properties], bool] = lambda props: True,
) -> None:  # fmt: skip
    """Set parameters of all nodes of a plugin, or of `some`."""
    for node in state.nodes if settings else ():
        if node.props.plugin_name() == plugin and some(node.props):
            for key, value in settings.items():
                node.props[key] = value


def _settings(settings: Mapping[str, float]) -> tuple[dict, dict]:
    """Settings of `bssrdf`, and of `translucent_walk`."""
    walk = {key: settings[key] for key in ("light", "layers") if key in settings}
    return {key: value for key, value in settings.items() if key != "layers"}, walk


def load_objects(scene: dict[str, Any] | str | Path, parameters: Mapping[str, str] | None = None) -> mi.Scene:
    """A Mitsuba scene whose objects are looked at one by one: none is merged with another, and no model is made.

    Args:
        scene: a dict as for `mitsuba.load_dict`, or the path of an XML file.
        parameters: values of the parameters $name of an XML file.

    Raises:
        ValueError: no such file or parameter, the file is no scene, a plugin refuses what it is given, or there is no
            translucent object.
    """
    state, config = parsed(scene, parameters or {})
    _surfaces(state)
    _transform(scene, state, config, apart=True)
    return _made(scene, state, config)


def _surfaces(state: ParserState) -> list[mi.Properties]:
    """The parameters of all translucent surfaces."""
    results = [node.props for node in state.nodes if node.props.plugin_name() == "translucent"]
    if not results:
        raise ValueError(NO_OBJECT)
    return results


def _made(scene: dict[str, Any] | str | Path, state: ParserState, config: ParserConfig) -> mi.Scene:
    """The scene; files that an XML file names are looked for beside it first."""
    before, here = mi.file_resolver(), mi.FileResolver(mi.file_resolver())
    if not isinstance(scene, dict):
        here.prepend(str(Path(scene).resolve().parent))
    mi.set_file_resolver(here)
    try:
        return mi.parser.instantiate(config, state)
    except RuntimeError as error:
        raise ValueError(first_cause(error)) from error
    finally:
        mi.set_file_resolver(before)


def _check_registered() -> None:
    try:
        mi.load_dict({"type": _INTEGRATORS[True]})
    except RuntimeError as error:
        if "not found" not in str(error):
            raise
        raise ValueError(
            "plugins must be registered before a scene is loaded, got none: call `full_geometry.register()` after "
            "`mitsuba.set_variant()`"
        ) from error


def parsed(scene: dict[str, Any] | str | Path, parameters: Mapping[str, str]) -> tuple[ParserState, ParserConfig]:
    """What a scene says, and how Mitsuba is to make it; ValueError if it cannot be read."""
    check_variant()
    _check_registered()
    config = mi.parser.ParserConfig(mi.variant())
    config.parallel = False  # objects then have the same numbers each time, and kernels are found in Dr.Jit's cache
    if not isinstance(scene, dict) and not Path(scene).is_file():
        near = did_you_mean(
            scene, (str(path) for s in (".xml", *SUFFIXES) for path in Path(scene).parent.glob(f"*{s}"))
        )
        raise ValueError(f"scene must be an XML or glTF file, got {str(scene)!r}, which does not exist{near}")
    if not isinstance(scene, dict) and Path(scene).suffix.lower() in EXPORTABLE:
        raise ValueError(f"scene must be an XML or glTF file, got {str(scene)!r}: export it as glTF 2.0 (.glb)")
    if is_gltf(scene) and parameters:
        raise ValueError(f"parameters must be left out of a glTF file, got {', '.join(parameters)}")
    try:
        if isinstance(scene, dict) or is_gltf(scene):
            state = mi.parser.parse_dict(
                config, _own_bitmaps(scene) if isinstance(scene, dict) else gltf_scene(Path(scene))
            )
        else:
            state = mi.parser.parse_file(config, str(scene), **parameters)
    except RuntimeError as error:
        raise _unreadable(scene, error) from error
    return state, config


def _transform(scene: dict[str, Any] | str | Path, state: ParserState, config: ParserConfig, apart: bool) -> None:
    """Resolve what a scene says; meshes of one translucent surface stay `apart`, or become one, as others do."""
    config.merge_meshes = False
    try:
        mi.parser.transform_all(config, state)
        if not (apart and _shares_surface(state)):
            config.merge_meshes = True
            mi.parser.transform_merge_meshes(config, state)
    except RuntimeError as error:
        raise _unreadable(scene, error) from error


def _apart(state: ParserState, model: str | None = None) -> bool:
    """Whether what renders a scene knows whole objects, and not what Mitsuba makes of several with the same surface."""
    known = [name for name in (model, *(str(props.get("model", "")) for props in _surfaces(state))) if name]
    walks = model is None and any(node.props.plugin_name() == _INTEGRATORS[True] for node in state.nodes)
    return walks or any(name in model_names() and of_objects(name) for name in known)


def _shares_surface(state: ParserState) -> bool:
    """Whether two meshes have the same translucent surface, which Mitsuba would merge."""
    found = []
    for node in state.nodes:
        if node.type == mi.ObjectType.Shape and node.props.plugin_name() not in NO_MESHES:
            found += [index for index in references(node.props).values() if holds_translucent(state, index)]
    return len(set(found)) < len(found)


def references(props: mi.Properties) -> dict[str, int]:
    """Numbers of the nodes that a node refers to, by name."""
    values = {key: props[key] for key in props.keys()}
    return {key: value.index() for key, value in values.items() if isinstance(value, mi.Properties.ResolvedReference)}


def holds_translucent(state: ParserState, index: int) -> bool:
    """Whether a node is a translucent surface, or something around one."""
    props = state.nodes[index].props
    return props.plugin_name() == "translucent" or any(holds_translucent(state, k) for k in references(props).values())


def apart(function: Callable, parse: Callable) -> Callable:
    """A function of Mitsuba that loads scenes, which keeps meshes apart where what renders them knows whole objects.

    Args:
        function: `mitsuba.load_dict`, `load_file` or `load_string`.
        parse: the function of `mitsuba.parser` for what that takes.
    """

    @functools.wraps(function)
    def found(scene: dict[str, Any] | str, *args: object, **more: object) -> mi.Scene | mi.Object:
        if not args and "optimize" not in more and _asks_apart(parse, scene, more):
            more["optimize"] = False
        return function(_own_bitmaps(scene), *args, **more)

    return found


def _own_bitmaps(scene: Any) -> Any:
    """A dict with copies of its bitmaps: Mitsuba writes spectra, and that bytes are linear, into those it is given."""
    if isinstance(scene, dict):
        return {key: _own_bitmaps(value) for key, value in scene.items()}
    return mi.Bitmap(scene) if isinstance(scene, mi.Bitmap) else scene


def _asks_apart(parse: Callable, scene: dict[str, Any] | str, more: Mapping[str, object]) -> bool:
    """Whether meshes of a scene have to stay apart; what cannot be read is left to who loads it."""
    if isinstance(scene, dict) and scene.get("type") != "scene":
        return False
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = False
    config.unused_parameters = config.unused_properties = mi.LogLevel.Debug
    try:
        state = parse(config, scene, **{key: value for key, value in more.items() if key != "parallel"})
        if not any(node.props.plugin_name() == "translucent" for node in state.nodes) or not _apart(state):
            return False
        mi.parser.transform_all(config, state)
    except (RuntimeError, TypeError):
        return False
    return _shares_surface(state)


def _unreadable(scene: dict[str, Any] | str | Path, error: RuntimeError) -> ValueError:
    name = "scene" if isinstance(scene, dict) else f"scene {str(scene)!r}"
    return ValueError(f"{name} cannot be read: {first_cause(error)}")


def _choose_integrator(
    state: ParserState, walks: bool, unnamed: bool, asked: tuple[bool, bool], settings: Mapping[str, float]
) -> None:
    """Make the integrator fit: whether a model, or anything, is asked for; one that is made gets the settings.
    Where there is none, and no model is named either (`unnamed`), it is `translucent_walk`."""
    wanted, (model, anything) = _INTEGRATORS[walks], asked
    ours = [node.props for node in state.nodes if node.props.plugin_name() in _INTEGRATORS.values()]
    for props in ours if model else ():
        _set_integrator(props, wanted)
    if ours:
        return
    others = [node.props for node in state.nodes if node.type == mi.ObjectType.Integrator]
    if not others:
        by_walks = walks or unnamed
        plugin = {"type": _INTEGRATORS[by_walks], **_settings(settings)[by_walks]}
        state.nodes[0].props["integrator"] = mi.load_dict(plugin)
    elif anything:
        name = others[0].plugin_name()
        warnings.warn(f"the integrator {name!r} of the scene is replaced by {wanted!r}", stacklevel=3)
        _set_integrator(others[0], wanted)
    else:
        warnings.warn(
            f"the integrator {others[0].plugin_name()!r} of the scene shows no light from inside translucent objects; "
            "name a model, and 'bssrdf' or 'translucent_walk' takes its place",
            stacklevel=3,
        )


def _set_integrator(props: mi.Properties, plugin: str) -> None:
    if props.plugin_name() == plugin:
        return
    props.set_plugin_name(plugin)
    for key in list(props.keys()):
        if key not in SHARED:
            del props[key]


def put(scene: mi.Scene, values: Mapping[str, Any], keys: list[str]) -> None:
    """Give parameters values that are data of kernels: literals would be code, compiled anew for each other value."""
    parameters = mi.traverse(scene)
    for key in keys:
        value = type(values[key])(values[key])
        dr.make_opaque(value)
        parameters[key] = value
    parameters.update()


def like(old: object, value: np.ndarray) -> object:
    """Numbers as a parameter of the same type as another."""
    if isinstance(old, float):
        return float(value.item())
    if is_pose(old):
        scalar = mi.ScalarTransform4f if len(value) == 4 else mi.ScalarTransform3f
        return type(old)(scalar(value))
    if dr.is_tensor_v(old):
        return type(old)(value.astype(np.float32))
    return type(old)(floats(value)) if dr.is_dynamic_v(old) and dr.depth_v(old) == 1 else type(old)(value.tolist())


def is_pose(value: object) -> bool:
    """Whether a parameter is a transformation: arrays take any name for components."""
    return not dr.is_array_v(value) and hasattr(value, "matrix")
