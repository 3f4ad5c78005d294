"""What a viewer changes of a scene, in the words of its file: light, media, camera and integrator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import mitsuba as mi
import numpy as np

from full_geometry.scenes.scene_files import references
from full_geometry.settings import PATH_TRACED
from full_geometry.surface.translucent import COEFFICIENTS, ETA
from halfspace_sss import materials

if TYPE_CHECKING:
    from mitsuba.parser import ParserState

RADIANCES = ("radiance", "irradiance", "intensity", "power")
SCALES = {"envmap": ("scale",), "sunsky": ("sun_scale", "sky_scale"), "sky": ("sky_scale",)}
OF_MEDIA = (*COEFFICIENTS, "material", "dilution", "channel")


@dataclass(frozen=True)
class Edits:
    """Changes of a scene.

    Args:
        turn: degrees, all light is turned by them about the vertical through the objects.
        tilt: and then about the horizontal across.
        stops: of the brightness of all light.
        environment: file of the environment map, "" for that of the scene.
        media: by name of an object the `material`, or `reflectance` and `mfp` (mm) of each channel, `g` and `eta`; with
            a `roughness` above 0 the boundary is rough.
    """

    turn: float = 0.0
    tilt: float = 0.0
    stops: float = 0.0
    environment: str = ""
    media: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


class Camera(NamedTuple):
    """A perspective camera: rows of `to_world` (4, 4) of Mitsuba, vertical field of view in degrees, and pixels."""

    to_world: tuple[tuple[float, ...], ...]
    fov: float
    width: int
    height: int

    def sensor(self, part: int = 1) -> mi.Sensor:
        """A sensor of Mitsuba, with one of `part` pixels of each row and column."""
        size = {name: max(value // part, 1) for name, value in (("width", self.width), ("height", self.height))}
        film = {"type": "hdrfilm", "pixel_format": "rgb", "rfilter": {"type": "box"}, **size}
        to_world = mi.ScalarTransform4f(np.asarray(self.to_world, dtype=np.float64))
        pose = {"to_world": to_world, "fov": float(self.fov), "fov_axis": "y"}
        return mi.load_dict({"type": "perspective", **pose, "film": film, "sampler": {"type": "independent"}})


class Way(NamedTuple):
    """How light inside is found: a model, "" for those of the surfaces, or "path_traced"; its light; and denoising."""

    model: str
    light: str
    denoise: bool = False

    def plugin(self, shared: Mapping[str, Any]) -> dict[str, Any]:
        """The dict of the integrator."""
        if self.model == PATH_TRACED:
            return {"type": "translucent_walk", "light": self.light, "layers": self.denoise, **shared}
        return {"type": "bssrdf", "light": self.light, **({"model": self.model} if self.model else {}), **shared}


def names_of(state: ParserState) -> dict[str, int]:
    """Names of the translucent surfaces of a scene, with the numbers of their nodes: ids, else of the first shape."""
    found = {}
    for k, node in enumerate(state.nodes):
        if node.props.plugin_name() == "translucent":
            holder = next((each for each in state.nodes if _holds(state, each, k)), node)
            name = node.props.id() or holder.props.id() or f"object {len(found)}"
            found[name if name not in found else f"{name} {len(found)}"] = k
    return found


def _holds(state: ParserState, shape: mi.parser.SceneNode, k: int) -> bool:
    """Whether a shape has the surface k, or one around it."""

    def within(props: mi.Properties) -> bool:
        return any(j == k or within(state.nodes[j].props) for j in references(props).values())

    return shape.type == mi.ObjectType.Shape and within(shape.props)


def name_nodes(state: ParserState) -> None:
    """Give each nameless object a name, so that it is known again in another scene of the same file."""
    for k, node in enumerate(state.nodes):
        if k and not node.props.id():
            node.props.set_id(f"node_{k}")


def change(state: ParserState, edits: Edits, turned: np.ndarray) -> None:
    """Make changes of a scene, as it was parsed.
    `state`: of the scene. `edits`: what is changed. `turned`: the transformation (4, 4) of its light. ValueError if an
    emitter has a radiance that cannot be scaled, or there is no such object."""
    _change_light(state, edits, mi.ScalarAffineTransform4d(turned), 2.0**edits.stops)
    names = names_of(state)
    for name, medium in edits.media.items():
        if name not in names:
            raise ValueError(f"object must be one of {', '.join(names)}, got {name!r}")
        _fill(state, state.nodes[names[name]].props, medium)


def _change_light(state: ParserState, edits: Edits, turned: mi.ScalarAffineTransform4d, factor: float) -> None:
    moves, environments = (edits.turn, edits.tilt) != (0, 0), 0
    for node in list(state.nodes):
        props, kind = node.props, node.props.plugin_name()
        emits = node.type == mi.ObjectType.Emitter
        lamp = node.type == mi.ObjectType.Shape and any(
            state.nodes[k].props.plugin_name() == "area" for k in references(props).values()
        )
        if moves and (lamp or emits and kind not in ("area", "constant")):
            key = next((key for key in ("position", "direction") if key in props and emits), "to_world")
            old = props[key] if key in props else mi.ScalarAffineTransform4d()
            of = {"position": mi.ScalarPoint3d, "direction": mi.ScalarVector3d}.get(key, lambda v: v)
            props[key] = turned @ of(old)
        if emits and factor != 1:
            _dim(props, kind, factor)
        if edits.environment and kind == "envmap":
            props["filename"], environments = edits.environment, environments + 1
    if edits.environment and not environments:
        raise ValueError("the scene must have an emitter envmap for its environment to be changed, got none")


def _dim(props: mi.Properties, kind: str, factor: float) -> None:
    """Scale the light of an emitter."""
    for key in SCALES.get(kind, [key for key in RADIANCES if key in props]):
        old = props[key] if key in props else 1.0
        if isinstance(old, mi.Properties.ResolvedReference):
            raise ValueError(f"{key} of the emitter {kind} must be a number or a colour to be dimmed, got a plugin")
        if hasattr(old, "wavelengths"):
            values = [factor * v for v in old.values]
            props[key] = type(old)(values[0]) if old.is_uniform() else type(old)(old.wavelengths, values)
        else:
            props[key] = old * factor


def _fill(state: ParserState, props: mi.Properties, medium: Mapping[str, Any]) -> None:
    """Put another medium below a surface, with a rough boundary where that is asked for."""
    medium = dict(medium)
    alpha = medium.pop("roughness", 0.0)
    for key in [key for key in props.keys() if key in OF_MEDIA] if medium else ():
        del props[key]
    for key, value in medium.items():
        props[key] = value if isinstance(value, str) else ", ".join(f"{v:.9g}" for v in np.atleast_1d(value))
    for key in references(props):
        if state.nodes[props[key].index()].type == mi.ObjectType.BSDF:
            del props[key]
    if alpha > 0:
        name, eta = (props[key] if key in props else None for key in ("material", "eta"))
        eta = materials.load(name).medium.eta if name else ETA if eta is None else eta
        rough = mi.Properties("roughdielectric")
        rough["alpha"], rough["int_ior"], rough["ext_ior"] = float(alpha), float(eta), 1.0
        props["boundary"] = added(state, rough, mi.ObjectType.BSDF)


def added(state: ParserState, props: mi.Properties, kind: mi.ObjectType) -> mi.Properties.ResolvedReference:
    """The reference to a node that is added to a scene."""
    node = mi.parser.SceneNode()
    node.type, node.props = kind, props
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def integrator_props(state: ParserState) -> mi.Properties | None:
    """The parameters of the integrator of a scene."""
    return next((node.props for node in state.nodes if node.type == mi.ObjectType.Integrator), None)


def put_integrator(state: ParserState, plugin: Mapping[str, Any]) -> None:
    """Give a scene an integrator, instead of its own."""
    props = integrator_props(state)
    if props is None:
        props = mi.Properties(plugin["type"])
        state.nodes[0].props["integrator"] = added(state, props, mi.ObjectType.Integrator)
        props = state.nodes[-1].props
    props.set_plugin_name(plugin["type"])
    for key in list(props.keys()):
        del props[key]
    for key, value in plugin.items():
        if key != "type":
            props[key] = value


def put_camera(state: ParserState, camera: Camera) -> None:
    """Let the first sensor of a scene stand and look as a camera; its film and its sampler stay but for the size."""
    sensor = next(node.props for node in state.nodes if node.type == mi.ObjectType.Sensor)
    for key in set(sensor.keys()) - set(references(sensor)):
        del sensor[key]
    sensor.set_plugin_name("perspective")
    sensor["to_world"] = mi.ScalarAffineTransform4d(np.asarray(camera.to_world, dtype=np.float64))
    sensor["fov"], sensor["fov_axis"] = float(camera.fov), "y"
    for film in [state.nodes[k] for k in references(sensor).values() if state.nodes[k].type == mi.ObjectType.Film]:
        for key in [key for key in film.props.keys() if key.startswith("crop_")]:
            del film.props[key]
        film.props["width"], film.props["height"] = camera.width, camera.height
