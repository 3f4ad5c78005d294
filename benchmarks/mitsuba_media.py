"""A scene with translucent objects as Mitsuba's own scene: a boundary around a homogeneous medium.

Mitsuba's volume path tracers, which nobody here wrote, then render the same light transport.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from full_geometry.scenes.scene_files import holds_translucent, parsed, references
from full_geometry.settings import MM_PER_UNIT
from full_geometry.surface.translucent import MediumSpec, is_smooth_boundary
from full_geometry.surface.varying import VaryingMedium
from halfspace_sss.checks import check_interval

FAR = 1e5  # scene units within which objects lie
VOLUME_PATH: dict[str, str | int] = {"type": "volpathmis", "max_depth": -1, "rr_depth": 64}


def with_media(
    scene: dict[str, Any] | str | Path, mm_per_unit: float, integrator: dict[str, Any] | None = None
) -> mi.Scene:
    """A Mitsuba scene in which each translucent object is a dielectric shape filled with a `homogeneous` medium,
    or with a `heterogeneous` one where the medium varies in space.

    The medium has the albedo sigma_s / sigma_t, the extinction sigma_t mm_per_unit in 1/(scene unit) and the phase
    function `hg`; the boundary is the dielectric of the surface, and `null` where that has the index 1: Mitsuba then
    connects events to emitters, counts no vertex there, and hides by `hide_emitters` what is behind it. Where an object
    is larger than the grid of its sigma_t, Mitsuba's medium is empty beyond it, while ours goes on as the
    grid's `wrap_mode` says.

    Args:
        scene: a dict as for `mitsuba.load_dict`, or a path of an XML file.
        mm_per_unit: length of a scene unit, mm.
        integrator: replaces the integrator of the scene; by default `volpathmis` without a limit of depth.

    Raises:
        ValueError: mm_per_unit is out of range, or an object has something that Mitsuba's media have not: other
            orders than "total", a boundary without reflection, a BSDF around its surface, or a mean cosine that
            differs between channels.
    """
    check_interval("mm_per_unit", mm_per_unit, *MM_PER_UNIT)
    state, config = parsed(scene, {})
    config.merge_meshes = False  # merged ones would lose the medium
    mi.parser.transform_all(config, state)
    for node in list(state.nodes):
        if node.type == mi.ObjectType.Shape:
            _fill(config, state, node.props, mm_per_unit)
    root = state.nodes[0].props
    for key, index in references(root).items():
        node = state.nodes[index]
        if node.type == mi.ObjectType.Integrator or node.props.plugin_name() in ("bssrdf", "translucent_walk"):
            del root[key]
    root["integrator"] = mi.load_dict(integrator or VOLUME_PATH)
    return mi.parser.instantiate(config, state)


def _fill(
    config: mi.parser.ParserConfig, state: mi.parser.ParserState, shape: mi.Properties, mm_per_unit: float
) -> None:
    """Replace the translucent surface of a shape by its boundary and an interior medium."""
    for key, index in references(shape).items():
        props = state.nodes[index].props
        if not holds_translucent(state, index) or "thickness" in props:  # a thin wall is a BSDF for Mitsuba too
            continue
        if props.plugin_name() != "translucent":
            raise ValueError(
                f"translucent must stand in no other BSDF for Mitsuba's media, got {props.plugin_name()} of "
                f"{shape.id()!r}"
            )
        surface = _instance(config, state, index)
        eta = float(surface.spec.medium.eta)
        plain = {"type": "null"} if eta == 1 else {"type": "dielectric", "int_ior": eta, "ext_ior": 1.0}
        shape[key] = mi.load_dict(plain) if is_smooth_boundary(surface.boundary) else surface.boundary
        shape["interior"] = medium(surface.spec, mm_per_unit)
        return


def _instance(config: mi.parser.ParserConfig, state: mi.parser.ParserState, index: int) -> mi.Object:
    """The object that a node stands for."""
    root, node = mi.parser.SceneNode(state.nodes[0]), mi.parser.SceneNode(state.nodes[index])
    state.nodes[0] = node
    try:
        return mi.parser.instantiate(config, state)
    finally:
        state.nodes[0] = root


def medium(spec: MediumSpec, mm_per_unit: float) -> mi.Medium:
    """The `homogeneous` or `heterogeneous` medium of a `MediumSpec`."""
    if spec.orders != "total" or not spec.reflection:
        raise ValueError(
            f"orders must be 'total', with reflection, for Mitsuba's media, got {spec.orders!r} and "
            f"reflection {spec.reflection} for {spec.label}"
        )
    if spec.priority is not None:
        raise ValueError(f"media must be without priority for Mitsuba's media, got {spec.priority:g} of {spec.label}")
    m = spec.medium
    if np.ptp(m.g) > 0:
        raise ValueError(f"g must be the same in all channels for Mitsuba's media, got {m.g} for {spec.label}")
    g = float(np.max(m.g))
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    if spec.textured is not None:
        raise ValueError(f"media must be without textures for Mitsuba's media, got those of {spec.label}")
    if spec.varying is not None and spec.varying.by_depth:
        raise ValueError(f"media must be without layers for Mitsuba's media, got {spec.label}")
    if spec.varying is not None:
        return mi.load_dict({"type": "heterogeneous", **_volumes(spec.varying, mm_per_unit), "phase": phase})
    scale = float(np.max(m.sigma_t))  # Mitsuba takes colours up to one
    albedo, sigma_t = (np.atleast_1d(v).tolist() for v in (m.albedo, m.sigma_t / scale))
    values = (
        {"albedo": {"type": "rgb", "value": albedo}, "sigma_t": {"type": "rgb", "value": sigma_t}}
        if len(albedo) == 3
        else {"albedo": albedo[0], "sigma_t": sigma_t[0]}
    )
    return mi.load_dict({"type": "homogeneous", **values, "scale": scale * mm_per_unit, "phase": phase})


def _volumes(varying: VaryingMedium, mm_per_unit: float) -> dict:
    """The coefficients of a `heterogeneous` medium."""
    scale, albedo = varying.factor, varying.albedo
    if varying.density is not None and np.ptp(scale) > 0:
        raise ValueError(f"sigma_t must be a grid of all channels for Mitsuba's media, got a scale of {scale.tolist()}")
    sigma_t = _one_voxel(scale) if varying.density is None else varying.density
    volume = _one_voxel(albedo) if varying.albedo_volume is None else varying.albedo_volume
    scale = mm_per_unit * (1.0 if varying.density is None else float(scale[0]))
    return {"sigma_t": sigma_t, "albedo": volume, "scale": scale}


def _one_voxel(values: np.ndarray) -> mi.Volume:
    """A volume that is the same everywhere: Mitsuba's constant ones take colours up to one only."""
    grid = mi.VolumeGrid(np.asarray(values, dtype=np.float32).reshape(1, 1, 1, -1))
    anywhere = mi.ScalarTransform4f().scale(2 * FAR).translate(-0.5)
    return mi.load_dict({"type": "gridvolume", "grid": grid, "raw": True, "to_world": anywhere})
