"""The identity of a scene: the same in every process and order of loading, another as soon as its image is another."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import halfspace_sss
from full_geometry.geometry.snapshot import object_digest, scene_hash
from full_geometry.scenes import reference
from full_geometry.scenes.reference import learnt
from full_geometry.scenes.scene_files import load_scene
from halfspace_sss.neural import universal
from halfspace_sss.neural.store import checksum_of, load_weights, save_weights
from halfspace_sss.neural.universal import shipped_weights

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

XML = """<scene version="3.0.0">
  <integrator type="bssrdf"/>
  <emitter type="constant"/>
  <shape type="sphere"><float name="radius" value="5"/>
    <bsdf type="translucent"><string name="material" value="marble"/><string name="model" value="better_dipole"/></bsdf>
  </shape>
  <shape type="rectangle"><transform name="to_world"><translate z="-9"/></transform>
    <bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf></shape>
  <sensor type="perspective"><sampler type="multijitter"><integer name="sample_count" value="16"/></sampler>
    <transform name="to_world"><lookat origin="0,0,40" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>
</scene>
"""
HOLDERS = pytest.mark.parametrize(
    "holder",
    ["{}", '<integrator type="aov"><string name="aovs" value="d:depth"/>{}</integrator>'],
    ids=["alone", "in aov"],
)
TELL = """
import sys
import full_geometry
import mitsuba as mi
from full_geometry.scenes.scene_files import load_scene
from full_geometry.geometry.snapshot import scene_hash
mi.set_variant("llvm_ad_rgb")
full_geometry.register()
scene = load_scene(sys.argv[1])
print(scene_hash(scene, scene.integrator()))
"""


def _hash(text: str, folder: Path) -> str:
    file = folder / "scene.xml"
    file.write_text(text)
    scene = load_scene(file)
    return scene_hash(scene, scene.integrator())


def _learnt(text: str, folder: Path) -> list[str]:
    file = folder / "scene.xml"
    file.write_text(text)
    scene = load_scene(file)
    return learnt(scene, scene.integrator())


def test_a_scene_without_ids_is_the_same_in_every_process(tmp_path: Path) -> None:
    here = _hash(XML, tmp_path)
    run = [sys.executable, "-c", TELL, str(tmp_path / "scene.xml")]
    assert subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip() == here


def test_a_scene_of_meshes_that_has_been_rendered_is_gone_on_with(tmp_path: Path) -> None:
    ball = '<shape type="sphere"><float name="radius" value="5"/>'
    assert ball in XML
    (tmp_path / "scene.xml").write_text(XML.replace(ball, '<shape type="cube">'))
    scene, file = mi.load_file(str(tmp_path / "scene.xml"), parallel=False), tmp_path / "a.exr"
    assert [reference.render(scene, file, spp=spp).spp for spp in (2, 4)] == [2, 4]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<shape type="sphere">', '<shape type="sphere" id="ball">'),
        ('name="sample_count" value="16"', 'name="sample_count" value="64"'),
        ('<emitter type="constant"/>', '<emitter type="constant" id="sky"/>'),
    ],
)
def test_names_and_numbers_of_samples_are_no_part_of_the_identity(old: str, new: str, tmp_path: Path) -> None:
    assert old in XML
    assert _hash(XML.replace(old, new), tmp_path) == _hash(XML, tmp_path)


def test_the_order_of_the_objects_is_no_part_of_the_identity(tmp_path: Path) -> None:
    lines = XML.splitlines()
    assert _hash("\n".join([*lines[:3], *lines[6:8], *lines[3:6], *lines[8:]]), tmp_path) == _hash(XML, tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('value="5"', 'value="5.00001"'),
        ("marble", "ketchup"),
        ("better_dipole", "standard_dipole"),
        ('<emitter type="constant"/>', '<emitter type="constant"><rgb name="radiance" value="1,1,0.99"/></emitter>'),
        ('type="multijitter"', 'type="independent"'),
        ('name="width" value="8"', 'name="width" value="9"'),
        ('origin="0,0,40"', 'origin="0,0,40.001"'),
        ('<integrator type="bssrdf"/>', '<integrator type="bssrdf"><float name="mm_per_unit" value="2"/></integrator>'),
        ('<texture type="checkerboard" name="reflectance"/>', '<rgb name="reflectance" value="0.5"/>'),
        ('<float name="radius"', '<boolean name="flip_normals" value="true"/><float name="radius"'),
    ],
)
def test_what_changes_the_image_changes_the_identity(old: str, new: str, tmp_path: Path) -> None:
    assert old in XML
    assert _hash(XML.replace(old, new), tmp_path) != _hash(XML, tmp_path)


@pytest.mark.parametrize(
    "parameter",
    [
        '<boolean name="hide_emitters" value="true"/>',
        '<integer name="rr_depth" value="4"/>',
        '<float name="connection_share" value="0.4"/>',
        '<string name="light" value="sampled"/>',
        '<boolean name="layers" value="true"/>',
    ],
)
def test_every_parameter_of_walks_is_part_of_the_identity(parameter: str, tmp_path: Path) -> None:
    plain, walk = '<integrator type="bssrdf"/>', '<integrator type="translucent_walk">{}</integrator>'
    assert _hash(XML.replace(plain, walk.format(parameter)), tmp_path) != _hash(
        XML.replace(plain, walk.format("")), tmp_path
    )


@pytest.mark.parametrize("kind", ["path", "volpathmis", "direct"])
@HOLDERS
def test_integrators_of_mitsuba_that_hide_emitters_make_other_renders(kind: str, holder: str, tmp_path: Path) -> None:
    shown, hidden = (
        holder.format(f'<integrator type="{kind}"><boolean name="hide_emitters" value="{value}"/></integrator>')
        for value in ("false", "true")
    )
    plain = '<integrator type="bssrdf"/>'
    assert _hash(XML.replace(plain, shown), tmp_path) != _hash(XML.replace(plain, hidden), tmp_path)


def test_media_that_differ_in_the_last_digits_are_different_scenes() -> None:
    def scene(sigma_s: float) -> str:
        bsdf = {"type": "translucent", "sigma_s": sigma_s, "sigma_a": 0.1, "model": "better_dipole"}
        found = load_scene({"type": "scene", "integrator": {"type": "bssrdf"}, "s": {"type": "sphere", "bsdf": bsdf}})
        return scene_hash(found, found.integrator())

    assert scene(2.0) == scene(2.0) != scene(float(np.nextafter(2.0, 3.0)))


def test_another_attribute_of_a_mesh_is_another_scene() -> None:
    def digest(name: str) -> str:
        return object_digest(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": name}}))

    assert digest("vertex_color") != digest("vertex_albedo")


@pytest.mark.parametrize("option", ["filter_type=nearest", "wrap_mode=clamp", "wrap_mode=mirror"])
@pytest.mark.parametrize("channels", [1, 3])
def test_another_filter_or_edge_of_a_texture_is_another_scene(option: str, channels: int) -> None:
    texels = np.random.default_rng(3).uniform(0.2, 0.8, (5, 7, channels)).astype(np.float32)
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 30).scale([2, 3, 1])

    def digest(**more: str) -> str:
        plain = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "to_uv": turned, **more}
        return object_digest(mi.load_dict({"type": "diffuse", "reflectance": plain}))

    name, value = option.split("=")
    assert digest() == digest(filter_type="bilinear", wrap_mode="repeat") != digest(**{name: value})


@pytest.mark.parametrize("channels", [1, 3])
def test_mirrored_voxels_and_another_filter_of_a_grid_are_another_medium(channels: int) -> None:
    voxels = np.random.default_rng(4).uniform(1, 9, (4, 5, 6, channels)).astype(np.float32)
    place = mi.ScalarTransform4f().translate([100, 0, 3]).rotate([0, 0.6, 0.8], 30).scale(4)

    def digest(step: int = 1, name: str = "trilinear") -> str:
        values = mi.VolumeGrid(np.ascontiguousarray(voxels[::step]))
        grid = {"type": "gridvolume", "grid": values, "raw": True, "filter_type": name, "to_world": place}
        bsdf = {"type": "translucent", "sigma_t": grid, "albedo": 0.9}
        found = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": bsdf}})
        return scene_hash(found, mi.load_dict({"type": "translucent_walk"}))

    assert digest() == digest()
    assert len({digest(), digest(step=-1), digest(name="nearest")}) == 3


def test_objects_that_swap_their_surfaces_are_another_scene() -> None:
    def scene(a: float, b: float) -> str:
        balls = {
            f"s{x:+g}": {
                "type": "sphere", "center": [x, 0, 0], "radius": 1.0,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value, value, 0.5]}},
            }
            for x, value in ((-3.0, a), (3.0, b))
        }  # fmt: skip
        found = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, **balls})
        return scene_hash(found, found.integrator())

    assert scene(0.1, 0.2) != scene(0.2, 0.1)


@HOLDERS
def test_weights_that_a_model_was_trained_to_are_part_of_what_a_render_is_known_by(
    holder, tmp_path, monkeypatch
) -> None:
    plain = '<integrator type="bssrdf"/>'
    text = XML.replace(plain, holder.format(plain)).replace("better_dipole", "neural")
    before = _learnt(text, tmp_path)
    arrays, record = load_weights(shipped_weights(), "neural")
    path = save_weights(tmp_path / "again.safetensors", "neural", arrays, record)
    monkeypatch.setattr(universal, "shipped_weights", lambda: path)
    assert _learnt(text, tmp_path) == before
    arrays["base"][0] *= 1.01
    path = save_weights(tmp_path / "other.safetensors", "neural", arrays, record)
    assert _learnt(text, tmp_path) != before


def test_media_by_textures_name_the_weights_that_their_networks_come_from(tmp_path) -> None:
    painted = '<texture type="checkerboard" name="reflectance"/><float name="mfp" value="0.5"/>'
    text = XML.replace('<string name="material" value="marble"/>', painted).replace("better_dipole", "neural")
    assert _learnt(text, tmp_path) == [checksum_of(shipped_weights(), "neural")]


@pytest.mark.slow
def test_gathered_light_is_known_by_the_weights_too(tmp_path) -> None:
    text = XML.replace("better_dipole", "neural")
    light = '<integrator type="bssrdf"><string name="light" value="gathered"/></integrator>'
    found = _learnt(text.replace('<integrator type="bssrdf"/>', light), tmp_path)
    assert len(found) == 3 and found == _learnt(text, tmp_path)


def test_weights_are_no_part_of_what_a_render_by_walks_is_known_by(tmp_path, monkeypatch) -> None:
    text = XML.replace('type="bssrdf"', 'type="translucent_walk"').replace("better_dipole", "neural")
    before = _learnt(text, tmp_path)
    monkeypatch.setattr(universal, "shipped_weights", lambda: tmp_path / "absent.safetensors")
    assert _learnt(text, tmp_path) == before


def test_every_learnt_model_tells_what_it_was_trained_to(stand_ins) -> None:
    medium = halfspace_sss.Medium([1.0, 2.0], [0.5, 0.1], 0.0, 1.3)
    told = {name: halfspace_sss.bssrdf(name, medium).checksums for name in halfspace_sss.models()}
    trained = {name: checksums for name, checksums in told.items() if checksums}
    assert trained.keys() == {"neural", "neural_material", "neural_paper"}
    assert all(len(checksums) == 2 for checksums in trained.values())
