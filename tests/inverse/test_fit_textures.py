"""The fit of textures to images: a checkerboard found, what is refused and told, files, and going on after a kill."""

from __future__ import annotations

import gc
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

from figures import app as cli  # noqa: E402
from full_geometry import inverse  # noqa: E402
from full_geometry.inverse.comparing import ViewComparison  # noqa: E402
from full_geometry.inverse.textures import TextureDescent, variables_of  # noqa: E402
from full_geometry.inverse.views import GivenView, read_views  # noqa: E402
from full_geometry.scenes.scene_files import open_scene  # noqa: E402
from full_geometry.surface.wrapped import surface_of  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")

XML = """<scene version="3.0.0">
  <integrator type="translucent_walk"><boolean name="hide_emitters" value="true"/></integrator>
  <emitter type="directional"><vector name="direction" x="-0.2" y="0.3" z="-1"/></emitter>
  <emitter type="constant"><float name="radiance" value="0.3"/></emitter>
  <sensor type="perspective">
    <float name="fov" value="9"/>
    <transform name="to_world"><lookat origin="0,0,40" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
  </sensor>
  <shape type="SHAPE" id="plate">
    <bsdf type="translucent">TEXTURE
      <string name="sigma_t" value="3"/><float name="eta" value="1.3"/>
    </bsdf>
    MORE
  </shape>
</scene>
"""
BITMAP = """<texture type="bitmap" name="KEY"><string name="filename" value="FILE"/><boolean name="raw" value="true"/>
</texture>"""
ATTRIBUTE = '<texture type="mesh_attribute" name="KEY"><string name="name" value="vertex_color"/></texture>'
PLATE = '<transform name="to_world"><scale x="3" y="3" z="1"/></transform>'


def _bitmap(folder: Path, values: np.ndarray, key: str = "albedo") -> Path:
    mi.Bitmap(np.ascontiguousarray(values, np.float32)).write(str(folder / "texels.exr"))
    texture = BITMAP.replace("KEY", key).replace("FILE", "texels.exr")
    path = folder / "a.xml"
    path.write_text(XML.replace("SHAPE", "cube").replace("TEXTURE", texture).replace("MORE", PLATE))
    return path


def _mesh(folder: Path) -> Path:
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale([3, 3, 1])})
    cube.add_attribute("vertex_color", 3, [0.8] * 3 * cube.vertex_count())
    cube.write_ply(str(folder / "plate.ply"))
    path, file = folder / "a.xml", '<string name="filename" value="plate.ply"/>'
    texture = ATTRIBUTE.replace("KEY", "albedo")
    path.write_text(XML.replace("SHAPE", "ply").replace("TEXTURE", texture).replace("MORE", file))
    return path


def _views(scene: Path, spp: int) -> list[GivenView]:
    return [GivenView.of("a", 0, np.array(mi.render(open_scene(scene), spp=spp, seed=99)))]


@pytest.mark.slow
def test_a_checkerboard_is_found_from_its_image(tmp_path: Path) -> None:
    i, j = np.indices((4, 4))
    true = np.where(((i + j) % 2 == 0)[..., None], [0.95, 0.9, 0.6], [0.7, 0.8, 0.9])
    views = _views(_bitmap(tmp_path, true), 2048)
    settings = inverse.FitSettings(steps=14, spp=128, tv=0)
    found = inverse.fit(_bitmap(tmp_path, np.full((4, 4, 3), 0.8)), views, ("albedo",), settings=settings)
    error = found.textures["albedo"] - true
    assert np.sqrt(np.square(error).mean()) < 0.03
    assert np.abs(error).max() < 0.1
    assert not found.told
    z = error / found.texture_errors["albedo"]
    assert 0.5 < np.sqrt(np.square(z).mean()) < 2


@pytest.mark.parametrize("kind", ["bitmap", "mesh"])
def test_pixels_know_the_texels_that_they_show(tmp_path: Path, kind: str) -> None:
    """Of odd numbers of rows and columns too, whose first and last ones are neighbours."""
    values = np.random.default_rng(0).uniform(0.2, 0.9, (5, 3, 3) if kind == "bitmap" else (24, 3))
    scene = open_scene(_bitmap(tmp_path, values) if kind == "bitmap" else _mesh(tmp_path))
    shape = scene.shapes()[0]
    if kind == "mesh":
        mesh = mi.traverse(shape)
        values = np.resize(values, (shape.vertex_count(), 3))
        mesh["vertex_color"] = values.ravel().tolist()
        mesh.update()
    view = GivenView.of("a", 0, np.ones((12, 12, 3), np.float32))
    comparison = ViewComparison(scene, [view], inverse.FitSettings())
    descent = TextureDescent(comparison, shape, variables_of(["albedo"], shape, 1.0, scene))
    at, si, _ = descent._points(0)
    seen = np.array(surface_of(shape).spec.textured.textures["albedo"].eval(si))
    wanted = np.stack([np.bincount(at, c, 144) / np.maximum(np.bincount(at, minlength=144), 1) for c in seen], axis=1)
    found = (descent._footprints[0, 0] @ values.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(found, wanted, atol=2e-4)
    assert (wanted > 0.1).mean() > 0.3


@pytest.mark.slow
def test_what_is_dark_is_known_less_and_what_is_not_seen_is_not_known(tmp_path: Path) -> None:
    """A lamp at the left of the plate."""
    path = _mesh(tmp_path)
    lamp = '<emitter type="point"><point name="position" x="-4" y="0" z="2.5"/></emitter>'
    path.write_text(re.sub("<emitter type=.(directional|constant).*</emitter>", lamp, path.read_text()))
    scene = open_scene(path)
    views = [GivenView.of("a", 0, np.array(mi.render(scene, spp=64, seed=9)))]
    settings = inverse.FitSettings(steps=2, spp=64, loss="l2", tv=0)
    error = inverse.fit(scene, views, ("albedo",), model=None, settings=settings).texture_errors["albedo"]
    x, _, z = np.array(mi.traverse(scene.shapes()[0])["vertex_positions"]).reshape(-1, 3).T
    seen = np.isfinite(error).all(axis=1)
    assert not seen[z < 0].any() and 2 * error[seen & (x < 0)].mean() < error[seen & (x > 0)].mean()


@pytest.mark.slow
def test_all_steps_of_a_fit_of_textures_run_the_same_kernels(tmp_path: Path) -> None:
    path, kernels = _bitmap(tmp_path, np.full((4, 4, 3), 0.8)), []
    view = GivenView.of("a", 0, np.full((12, 12, 3), 0.5, np.float32))

    def keep(*_: Any) -> None:
        kernels.append({kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel})

    settings = inverse.FitSettings(steps=3, spp=4)
    gc.collect()  # scenes of other tests would leave the registry between two steps, and change their kernels
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        inverse.fit(path, [view], ("albedo", "sigma_t"), settings=settings, progress=keep)
    assert kernels[2] and kernels[2] <= kernels[1]


def test_textures_that_cannot_be_fitted_are_refused_by_name(tmp_path: Path) -> None:
    view = [GivenView.of("a", 0, np.full((12, 12, 3), 0.5, np.float32))]

    def refused(match: str, scene: Path, *names: str) -> None:
        with pytest.raises(ValueError, match=match):
            inverse.fit(scene, view, names)

    path = _bitmap(tmp_path, np.full((4, 4, 3), 0.3), "reflectance")
    path.write_text(path.read_text().replace("sigma_t", "mfp"))
    refused("parameter must be one of reflectance, sigma_t, mfp, alpha, got 'albedo'", path, "albedo")
    path = _bitmap(tmp_path, np.full((4, 4, 3), 0.3))
    refused("sigma_t or mfp, got both", path, "albedo", "sigma_t", "mfp")
    board = '<texture type="checkerboard" name="albedo"/>'
    path.write_text(XML.replace("SHAPE", "cube").replace("TEXTURE", board).replace("MORE", PLATE))
    refused("albedo of 'plate' must be a bitmap or mesh_attribute to be fitted, got a Checkerb", path, "albedo")


def test_a_fit_of_bytes_is_that_of_their_colours_and_bytes_of_a_scene_that_is_there_are_refused(tmp_path: Path) -> None:
    bytes_ = np.random.default_rng(0).integers(90, 220, (4, 4, 3), dtype=np.uint8)
    colours = ((bytes_ / 255 + 0.055) / 1.055) ** 2.4  # of sRGB
    view, settings = GivenView.of("a", 0, np.full((12, 12, 3), 0.6, np.float32)), inverse.FitSettings(steps=2, spp=16)
    path, ends = _bitmap(tmp_path, colours), []
    for _ in range(2):
        ends.append(inverse.fit(path, [view], ("albedo",), settings=settings))
        mi.Bitmap(bytes_).write(str(tmp_path / "texels.png"))
        text = path.read_text().replace("texels.exr", "texels.png")
        path.write_text(text.replace('"raw" value="true"', '"raw" value="false"'))
    assert ends[1].steps[0].values["albedo"] == pytest.approx(colours.mean(axis=(0, 1)), rel=1e-5)
    np.testing.assert_allclose(ends[1].textures["albedo"], ends[0].textures["albedo"], atol=1e-3)
    assert np.abs(ends[1].textures["albedo"] - colours).min() > 0
    with pytest.raises(
        ValueError, match="bitmap of albedo of 'plate' must have floats to be fitted, got bytes: load it"
    ):
        inverse.fit(open_scene(path), [view], ("albedo",), model=None, settings=settings)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bitmap", "mesh"])
def test_a_killed_fit_of_textures_goes_on_with_the_same_bits_and_writes_a_scene(tmp_path: Path, kind: str) -> None:
    path = _bitmap(tmp_path, np.full((4, 6, 3), 0.8)) if kind == "bitmap" else _mesh(tmp_path)
    mi.Bitmap(np.array(mi.render(open_scene(path), spp=64, seed=9)) * 1.1).write(str(tmp_path / "b.exr"))
    (tmp_path / "views.json").write_text(json.dumps({"views": [{"image": "b.exr"}]}))
    arguments = ["fit", str(path), "--images", str(tmp_path / "views.json"), "--parameter", "albedo,sigma_t"]
    arguments += ["--steps", "4", "--spp", "16"]
    whole = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path / "whole")])
    assert whole.exit_code == 0, whole.output

    def kill(done: int, *_: Any) -> None:
        if done == 3:
            raise KeyboardInterrupt

    how = {"settings": inverse.FitSettings(steps=4, spp=16), "work": tmp_path / "work"}
    with pytest.raises(KeyboardInterrupt):
        inverse.fit(path, read_views(tmp_path / "views.json"), ("albedo", "sigma_t"), progress=kill, **how)
    rest = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path / "rest"), "--work", str(tmp_path / "work")])
    assert rest.exit_code == 0, rest.output
    file = {"bitmap": "a_fit_albedo.exr", "mesh": "a_fit.ply"}[kind]
    assert (tmp_path / "whole" / file).read_bytes() == (tmp_path / "rest" / file).read_bytes()
    numbers = json.loads((tmp_path / "rest" / "a_fit.json").read_text())
    surface = open_scene(tmp_path / "rest" / "a_fit.xml").shapes()[0].bsdf()
    assert np.ravel(surface.sigma_t) == pytest.approx(numbers["values"]["sigma_t"], rel=1e-6)
    albedo, _ = surface.spec.textured.values_on(open_scene(tmp_path / "rest" / "a_fit.xml").shapes()[0])
    means = [row["values"]["albedo"] for row in numbers["steps"]]
    assert means[0] == pytest.approx([0.8] * 3, rel=1e-5) and means[0] != means[-1]
    assert (np.abs(albedo - 0.8) > 1e-3).any()
    if kind == "bitmap":
        error = np.array(mi.Bitmap(str(tmp_path / "rest" / "a_fit_albedo_error.exr")))
        assert error.shape == (4, 6, 3) and (error > 0).any()
    else:
        assert "texels or vertices of albedo are seen by no view" in " ".join(whole.output.split())


@pytest.mark.slow
def test_reflectance_path_length_and_roughness_of_a_photographed_object_explain_a_view_that_is_held_out(
    tmp_path: Path,
) -> None:
    """Cameras, lamps and masks as of photographs."""
    lamp = """<emitter type="point" id="lamp"><point name="position" x="0" y="0" z="30"/>
      <rgb name="intensity" value="1500"/></emitter>"""
    boundary = """<bsdf type="roughdielectric"><float name="alpha" value="ALPHA"/><float name="int_ior" value="1.3"/>
      <float name="ext_ior" value="1"/></bsdf>"""
    i, j = np.indices((4, 4))
    true = np.where(((i + j) % 2 == 0)[..., None], [0.4, 0.3, 0.1], [0.2, 0.25, 0.3])

    def scene(values: np.ndarray, alpha: float, mfp: float) -> Path:
        path = _bitmap(tmp_path, values, "reflectance")
        text = path.read_text().replace('name="sigma_t" value="3"', f'name="mfp" value="{mfp}"')
        light = text[text.index("  <emitter") : text.index("  <sensor")]
        text = text.replace(light, lamp).replace("</bsdf>", boundary.replace("ALPHA", str(alpha)) + "</bsdf>", 1)
        path.write_text(text.replace("<boolean", '<string name="light" value="precomputed"/><boolean', 1))
        return path

    shown, rows = open_scene(scene(true, 0.3, 0.5)), []
    parameters = mi.traverse(shown)
    for k, place in enumerate(([0, 3, 30], [20, 0, 20], [-12, 10, 25])):
        parameters["lamp.position"] = mi.Point3f(place)
        parameters.update()
        image = np.array(mi.render(shown, spp=256, seed=90 + k))
        mi.Bitmap(image).write(str(tmp_path / f"{k}.exr"))
        mi.Bitmap((image.max(axis=2, keepdims=True) > 0).astype(np.float32)).write(str(tmp_path / f"mask{k}.exr"))
        camera = {"origin": [0, 0, 40], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 9}
        row = {"image": f"{k}.exr", "mask": f"mask{k}.exr", "camera": camera, "edits": {"lamp.position": place}}
        rows.append({**row, "held_out": k == 2})
    (tmp_path / "views.json").write_text(json.dumps({"views": rows}))
    settings = inverse.FitSettings(steps=8, spp=32, light="precomputed", test_spp=256)
    views = read_views(tmp_path / "views.json")
    start = scene(np.full((4, 4, 3), 0.25), 0.2, 0.8)
    found = inverse.fit(start, views, ("reflectance", "mfp", "alpha"), settings=settings)
    assert found.views[-1].held_out and found.views[-1].relative_l1 < 0.1
    assert found.values["alpha"] == pytest.approx(0.3, abs=0.05)
