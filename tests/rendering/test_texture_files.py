"""Textures by files of every kind: the same colour is the same medium and the same picture."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_textures import _mesh
from test_translucent_walk import _scene

from full_geometry.settings import Settings
from full_geometry.surface.textured import attributes, texels
from full_geometry.transport.prepare import make_objects

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

BYTES = np.array([[[203, 149, 89], [90, 180, 40]]] * 2, dtype=np.uint8)  # two columns
HALF = 2.0**-11  # rounding of 16 bits, to which Mitsuba brings those of PNG too
KINDS = {  # name: file, texels of (bytes, shown values), rounding
    "8 bits": ("a.png", lambda c, v: c, 0),
    "16 bits": ("a.png", lambda c, v: c.astype(np.uint16) * 257, HALF),
    "half": ("a.exr", lambda c, v: v.astype(np.float16), HALF),
    "float": ("a.exr", lambda c, v: v.astype(np.float32), 0),
    "alpha": ("a.png", lambda c, v: np.append(c, np.full_like(c[..., :1], 40), axis=2), 0),
    "float alpha": ("a.exr", lambda c, v: np.append(v, np.full_like(v[..., :1], 0.2), axis=2).astype(np.float32), 0),
    "grey": ("a.png", lambda c, v: c[..., :1], 0),
    "grey of 16 bits": ("a.png", lambda c, v: c[..., :1].astype(np.uint16) * 257, HALF),
    "grey float": ("a.exr", lambda c, v: v[..., :1].astype(np.float32), 0),
}
SURFACES = {
    "reflectance": {"mfp": 0.3},
    "albedo": {"sigma_t": 3.0},
    "mfp": {"reflectance": 0.5},
    "sigma_t": {"albedo": 0.9},
}


def _values(raw: bool) -> np.ndarray:
    """What the bytes show: sRGB in linear light, of which 203, 149, 89 are 0.597, 0.300, 0.100."""
    x = BYTES / 255
    return x if raw else np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def _file(folder: Path, kind: str, raw: bool) -> dict:
    file, texels, _ = KINDS[kind]
    mi.Bitmap(np.ascontiguousarray(texels(BYTES, _values(raw)))).write(str(folder / file))
    return {"type": "bitmap", "filename": str(folder / file), "raw": raw, "filter_type": "nearest"}


def _inside(parameter: str, texture: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "reflectance is a bitmap of 8 bits that is read raw")
        surface = {"type": "translucent", parameter: texture, **SURFACES[parameter], "eta": 1.4}
        return mi.load_dict(surface).spec


@pytest.mark.parametrize("raw", [False, True], ids=["srgb", "raw"])
@pytest.mark.parametrize(
    ("kind", "parameter"), [*((kind, "reflectance") for kind in KINDS), *(("8 bits", name) for name in [*SURFACES][1:])]
)
def test_a_texture_of_every_kind_is_the_medium_of_its_colours(
    tmp_path: Path, kind: str, raw: bool, parameter: str
) -> None:
    """At each texel, of all texels as models see them, and in their mean."""
    values = _values(raw)
    values = values[..., :1].repeat(3, axis=2) if "grey" in kind else values
    wanted = _inside(parameter, {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True})
    found, rtol = _inside(parameter, _file(tmp_path, kind, raw)), 2 * KINDS[kind][2] + 1e-5
    sphere = mi.load_dict({"type": "sphere"})
    for a, b in zip(found.textured.values_on(sphere), wanted.textured.values_on(sphere)):
        np.testing.assert_allclose(np.broadcast_to(a, b.shape), b, rtol=rtol)
    for name in ("albedo", "sigma_t"):
        np.testing.assert_allclose(getattr(found.medium, name), getattr(wanted.medium, name), rtol=rtol)
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f([0.25, 0.75], 0.25)
    at = found.textured.at(si)
    shown = [np.array(value) + np.zeros((3, 2)) for value in (at.albedo, at.sigma_t)]
    for a, b in zip(shown, found.textured.values_on(sphere)):
        np.testing.assert_allclose(a.T, np.broadcast_to(b, (4, 3))[:2], rtol=1e-5)


@pytest.mark.parametrize("kind", ["8 bits", "alpha", "grey", "16 bits", "float"])
def test_colours_in_bytes_that_are_read_raw_are_warned_of(tmp_path: Path, kind: str) -> None:
    """Once, for reflectance, which people paint; a linear file of 8 bits and one of more bits do not warn."""
    told = []
    for parameter, raw in (("reflectance", True), ("reflectance", False), ("albedo", True)):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            mi.load_dict({"type": "translucent", parameter: _file(tmp_path, kind, raw), **SURFACES[parameter]})
        told.append([str(w.message) for w in found if "8 bits that is read raw, as linear values" in str(w.message)])
    assert [len(each) for each in told] == [int(kind in ("8 bits", "alpha", "grey")), 0, 0]


def test_the_example_of_the_guide_has_the_colours_of_its_file(tmp_path: Path) -> None:
    guide = (Path(__file__).parents[2] / "docs" / "rendering.md").read_text(encoding="utf-8")
    (example,) = [block for block in re.findall("```xml\n(.*?)```", guide, re.DOTALL) if "skin.png" in block]
    mi.Bitmap(BYTES).write(str(tmp_path / "skin.png"))
    (surface,) = re.findall("<bsdf.*</bsdf>", example.replace("skin.png", str(tmp_path / "skin.png")), re.DOTALL)
    surface = mi.load_string(surface.replace("<bsdf", "<bsdf version='3.0.0'"))
    values = texels(surface.spec.textured.textures["reflectance"])
    np.testing.assert_allclose(values, _values(False).reshape(-1, 3), rtol=1e-6)


def test_colours_are_their_luminance_under_a_mono_variant(mono: None, tmp_path: Path) -> None:
    """As Mitsuba shows them, of a bitmap and of vertices."""
    inside, luminance = (
        _inside("albedo", _file(tmp_path, "8 bits", False)),
        _values(False)[0] @ [0.212671, 0.71516, 0.072169],
    )
    values, si = inside.textured.values_on(mi.load_dict({"type": "sphere"}))[0], mi.SurfaceInteraction3f()
    si.uv = mi.Point2f([0.25, 0.75], 0.25)
    np.testing.assert_allclose(values.ravel(), np.tile(luminance, 2), rtol=1e-5)
    np.testing.assert_allclose(np.ravel(inside.textured.at(si).albedo), luminance, rtol=1e-5)
    np.testing.assert_allclose(inside.medium.albedo, luminance.mean(), rtol=1e-5)
    mesh = _mesh(np.tile(_values(False)[0, 0], (4, 1)))
    shown = mi.load_dict({"type": "mesh_attribute", "name": "vertex_color"})
    np.testing.assert_allclose(attributes("albedo", shown, mesh), luminance[0], rtol=1e-5)


@pytest.mark.filterwarnings("ignore:object 'object' is not closed")
def test_colours_of_vertices_are_the_medium_of_the_bitmap_and_bytes_there_are_refused() -> None:
    surface = {"reflectance": {"type": "mesh_attribute", "name": "vertex_color"}, "mfp": 0.3, "eta": 1.4}

    def painted(colours: np.ndarray) -> Any:
        props = mi.Properties()
        props["bsdf"] = mi.load_dict({"type": "translucent", **surface, "model": "lambert"})
        scene = _scene({})
        scene["object"] = _mesh(np.tile(colours, (4, 1)).astype(float), props=props)
        return make_objects(mi.load_dict(scene), Settings())[0]

    wanted = _inside("reflectance", mi.load_dict({"type": "rgb", "value": _values(False)[0, 0].tolist()})).medium
    found = painted(_values(False)[0, 0])
    np.testing.assert_allclose([m.albedo for m in found.media], wanted.albedo, rtol=1e-5)
    with pytest.raises(
        ValueError, match=r"reflectance must be in \[0, 1\], got 203.0 in an attribute of 'object'; byt"
    ):
        painted(BYTES[0, 0])


WALK, SAMPLED = {"type": "translucent_walk"}, {"type": "bssrdf"}


@pytest.mark.parametrize(
    ("integrator", "parameter", "raw"),
    [(WALK, "reflectance", False), (WALK, "mfp", True), (SAMPLED, "reflectance", False), (SAMPLED, "mfp", True)],
)  # fmt: skip
def test_a_painted_object_looks_alike_by_bytes_and_by_floats(
    tmp_path: Path, integrator: dict, parameter: str, raw: bool
) -> None:
    """To 0.1 %."""
    images = []
    for kind in ("8 bits", "float"):
        texture = {**_file(tmp_path, kind, raw), "to_uv": mi.ScalarTransform4f().scale([2, 1, 1])}
        surface = {parameter: texture, **SURFACES[parameter], "eta": 1.4, "model": "better_dipole"}
        scene = {**_scene(surface), "integrator": integrator}
        images.append(mi.render(mi.load_dict(scene), spp=64, seed=1).numpy())
    np.testing.assert_allclose(images[0], images[1], atol=1e-3 * images[1].max())
    assert images[0].mean() < 0.8
