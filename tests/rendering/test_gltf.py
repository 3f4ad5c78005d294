"""Scenes of glTF, as Blender writes them: the same as the same scenes as dicts; refusals by name."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from full_geometry.scenes.gltf import gltf_scene
from full_geometry.scenes.scene_files import load_scene, names_nothing, open_scene
from full_geometry.surface.sheets import is_sheet
from full_geometry.surface.wrapped import surface_of, wrapping_of
from halfspace_sss import Medium
from halfspace_sss.materials import load

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")
gltf = pytest.importorskip("pygltflib")

SKIN = {"sss_mfp": [1.2, 0.5, 0.3], "sss_model": "better_dipole"}
DOWN = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]  # what looks along -z looks down
TURNED = [0.5, 0.5, 0.5, 0.5]  # x becomes y, y becomes z
VOLUME = {"thicknessFactor": 1.0, "attenuationDistance": 0.01, "attenuationColor": [0.9, 0.5, 0.1]}


def _ball() -> tuple[np.ndarray, np.ndarray]:
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1.5], [0, 0, -1]], dtype=np.float32)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return points, np.array(faces, dtype=np.uint16)


def _uv(points: np.ndarray) -> np.ndarray:
    return points[:, :2] * np.float32(0.5) + np.float32(0.5)


def _glb(folder: Path, extras: dict | None = None, color: tuple = (0.8, 0.5, 0.3), **changes: Any) -> Path:
    """A ball of 20 to 30 mm radius at (0, 0.1, 0), a lamp above, and a camera 0.2 m before it, in a file."""
    points, faces = _ball()
    texels = mi.Bitmap(np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8))
    stream = mi.MemoryStream()
    texels.write(stream, mi.Bitmap.FileFormat.PNG)
    parts = [points.tobytes(), points.tobytes(), _uv(points).tobytes(), faces.tobytes(), stream.raw_buffer()]
    starts = np.cumsum([0, *map(len, parts)])
    views = [gltf.BufferView(buffer=0, byteOffset=int(a), byteLength=len(b)) for a, b in zip(starts, parts)]
    kinds = [(5126, 6, "VEC3"), (5126, 6, "VEC3"), (5126, 6, "VEC2"), (5123, 24, "SCALAR")]
    accessors = [gltf.Accessor(bufferView=k, componentType=c, count=n, type=t) for k, (c, n, t) in enumerate(kinds)]
    base = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5}
    if changes.pop("textured", False):
        base["baseColorTexture"] = gltf.TextureInfo(index=0)
    material = gltf.Material(
        name="skin", extras=SKIN if extras is None else extras, extensions=changes.pop("parts", {}),
        pbrMetallicRoughness=gltf.PbrMetallicRoughness(**base),
    )  # fmt: skip
    for name, value in changes.pop("look", {}).items():
        setattr(material, name, value)
    ball = gltf.Node(name="Ball.001", mesh=0, scale=[-0.02, 0.02, 0.02], rotation=TURNED)
    light = {"KHR_lights_punctual": {"light": 0}}
    doc = gltf.GLTF2(
        scene=0, scenes=[gltf.Scene(nodes=[0, 2, 3])], accessors=accessors, bufferViews=views, materials=[material],
        nodes=[
            gltf.Node(children=[1], translation=[0.0, 0.1, 0.0]), ball,
            gltf.Node(name="Light", translation=[0.1, 0.3, 0.2], rotation=DOWN, extensions=light),
            gltf.Node(name="Camera", camera=0, translation=[0.0, 0.1, 0.2], extras={"width": 16, "height": 16}),
        ],
        meshes=[gltf.Mesh(primitives=[gltf.Primitive(
            attributes=gltf.Attributes(POSITION=0, NORMAL=1, TEXCOORD_0=2), indices=3, material=0)])],
        cameras=[gltf.Camera(type="perspective", perspective=gltf.Perspective(yfov=0.3, znear=0.01, aspectRatio=1.0))],
        extensions={"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 683.0, "color": [1, 0.9, 0.8]}]}},
        extensionsUsed=["KHR_lights_punctual"], images=[gltf.Image(bufferView=4, mimeType="image/png")],
        textures=[gltf.Texture(source=0)], buffers=[gltf.Buffer(byteLength=int(starts[-1]))],
    )  # fmt: skip
    for name, value in changes.items():
        setattr(doc, name, value)
    doc.set_binary_blob(b"".join(parts))
    path = folder / ("ball.gltf" if "buffers" in changes else "ball.glb")
    if path.suffix == ".gltf":  # by `save` it would have other buffers
        path.write_text(doc.to_json())
    else:
        doc.save(str(path))
    return path


def _ply(path: Path) -> Path:
    """The ball where it stands, mirrored and turned, with normals and uv, by which tangents are chosen."""
    points, faces = _ball()
    turned = (points * [-1.0, 1.0, 1.0])[:, [2, 0, 1]]
    normals = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    rows = [" ".join(map(repr, row)) for row in np.hstack([0.02 * turned + [0, 0.1, 0], normals, _uv(points)]).tolist()]
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
    head = f"ply\nformat ascii 1.0\nelement vertex 6\n{names}element face 8\nproperty list uchar int vertex_indices\n"
    path.write_text("\n".join([head + "end_header", *rows, *(f"3 {a} {b} {c}" for c, b, a in faces)]) + "\n")
    return path


@pytest.mark.filterwarnings("ignore")
def test_a_translucent_ball_is_that_of_the_same_scene_as_a_dict(tmp_path: Path) -> None:
    surface = {"type": "translucent", "reflectance": "0.8,0.5,0.3", "mfp": "1.2,0.5,0.3", "eta": 1.5}
    view = mi.ScalarTransform4f().look_at([0, 0.1, 0.2], [0, 0.1, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene", "integrator": {"type": "bssrdf", "mm_per_unit": 1000.0},
        "lamp": {"type": "point", "position": [0.1, 0.3, 0.2], "intensity": {"type": "rgb", "value": [1, 0.9, 0.8]}},
        "sensor": {"type": "perspective", "fov": math.degrees(0.3), "to_world": view, "film": film},
        "ball": {"type": "ply", "filename": str(_ply(tmp_path / "ball.ply")),
                 "bsdf": {**surface, "model": "better_dipole"}},
    }  # fmt: skip
    expected, found = (np.array(mi.render(load_scene(s), spp=16, seed=1)) for s in (scene, _glb(tmp_path)))
    assert expected.mean() > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * expected.mean())


SCATTER = {"multiscatterColor": [0.5, 0.2, 0.1], "scatterAnisotropy": 0.3}
DEPTH = -np.log(VOLUME["attenuationColor"]) / 10
MEDIA = {  # extras, extensions, medium
    "custom": ({"sss_material": "skin1"}, {}, load("skin1").medium),
    "principled": (
        {"sss_radius": [1.0, 0.2, 0.1], "sss_scale": 0.05},
        {"KHR_materials_ior": {"ior": 1.4}},
        Medium.from_principled((0.8, 0.5, 0.3), (1.0, 0.2, 0.1), 0.05, 0.0, 1.4),
    ),
    "scattering": (
        {},
        {"KHR_materials_volume": VOLUME, "KHR_materials_volume_scatter": SCATTER},
        Medium.from_gltf([0.5, 0.2, 0.1], 0.01, [0.9, 0.5, 0.1], 0.3),
    ),
    "clear": (
        {},
        {"KHR_materials_volume": VOLUME, "KHR_materials_transmission": {"transmissionFactor": 1.0}},
        Medium((0.0, 0.0, 0.0), DEPTH, 0.0, 1.5),
    ),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("of", MEDIA)
def test_media_are_those_of_custom_properties_and_extensions(of: str, tmp_path: Path) -> None:
    extras, parts, medium = MEDIA[of]
    path = _glb(tmp_path, extras, parts=parts)
    scene = open_scene(path)
    found = surface_of(scene.shapes()[0]).spec.medium
    for key in ("sigma_s", "sigma_a", "g", "eta"):
        np.testing.assert_allclose(getattr(found, key), getattr(medium, key), rtol=1e-5, atol=1e-9)
    assert scene.integrator().mm_per_unit == 1000
    assert names_nothing(path)


def test_textures_keep_their_place_and_are_multiplied(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"ball.glb: not taken from it: roughness \(skin\)$"):
        surface = gltf_scene(_glb(tmp_path, textured=True))["material skin"]
    texture, si = mi.load_dict(surface["reflectance"]), mi.SurfaceInteraction3f()
    si.uv = mi.Point2f([0.25, 0.75, 0.25, 0.75], [0.25, 0.25, 0.75, 0.75])  # v goes down in glTF
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]) * [0.8, 0.5, 0.3]
    np.testing.assert_allclose(np.array(texture.eval(si)).T, colors, atol=1e-6)


def test_a_weight_blends_the_medium_with_the_surface(tmp_path: Path) -> None:
    bumps = {"normalTexture": gltf.NormalMaterialTexture(index=0)}
    told = r"not taken from it: roughness \(skin\), mirrored uv of Ball.001 under its normalTexture$"
    with pytest.warns(UserWarning, match=told):
        blend = gltf_scene(_glb(tmp_path, {**SKIN, "sss_weight": 0.25}, look=bumps))["material skin"]
    assert [blend[key]["type"] for key in ("bsdf_0", "bsdf_1")] == 2 * ["normalmap"]
    assert [blend[key]["bsdf"]["type"] for key in ("bsdf_0", "bsdf_1")] == ["principled", "translucent"]
    ball = {"type": "sphere", "bsdf": blend}
    around = wrapping_of(mi.load_dict({"type": "scene", "ball": ball}).shapes()[0])
    assert float(around.mixes[0].share(dr.zeros(mi.SurfaceInteraction3f), mi.Bool(True))[0]) == 0.25
    with pytest.raises(ValueError, match=r"sss_weight must be a number in \(0, 1\], got 2"):
        gltf_scene(_glb(tmp_path, {**SKIN, "sss_weight": 2}))


@pytest.mark.filterwarnings("ignore")
def test_a_thickness_makes_a_thin_wall(tmp_path: Path) -> None:
    look = gltf_scene(_glb(tmp_path, {"sss_mfp": [1.2, 0.5, 0.3], "sss_thickness": 0.3}))["material skin"]
    assert is_sheet(mi.load_dict(look))


def test_what_is_not_taken_is_listed_once(tmp_path: Path) -> None:
    parts = {
        "KHR_materials_sheen": {},
        "KHR_materials_specular": {"specularFactor": 0.5, "specularColorFactor": [1, 0, 0]},
    }
    with pytest.warns(UserWarning) as warned:
        surface = gltf_scene(_glb(tmp_path, {}, parts=parts, animations=[gltf.Animation()]))["material skin"]["bsdf"]
    (message,) = [str(w.message) for w in warned]
    wanted = "animations, KHR_materials_sheen (skin), specularColorFactor of KHR_materials_specular (skin)"
    assert message.endswith(f"ball.glb: not taken from it: {wanted}")
    assert surface["type"] == "principled"
    assert ((surface["eta"] - 1) / (surface["eta"] + 1)) ** 2 == pytest.approx(0.02)


def _transmits(clear: float = 0.0, spread: float = 0.0, solid: dict | None = None) -> dict:
    parts = {
        "KHR_materials_transmission": {"transmissionFactor": clear},
        "KHR_materials_diffuse_transmission": {
            "diffuseTransmissionFactor": spread,
            "diffuseTransmissionColorFactor": [1.0, 0.0, 0.0],
        },
    }
    return parts if solid is None else {**parts, "KHR_materials_volume": solid}


F, COLOR = 0.047, np.array([0.8, 0.5, 0.3])  # of light that arrives by a cosine of 0.7: mirrored; the base colour
PASSED = {  # extensions: reflected, transmitted, what is not taken
    "opaque": ({}, F + COLOR, 0.0, ""),
    "pane": (_transmits(clear=0.5), F + 0.5 * COLOR, 0.5 * (1 - F) * COLOR, ""),
    "leaf": (_transmits(spread=0.4), 0.6 * (F + COLOR), np.array([0.4, 0, 0]), "gloss of diffuseTransmissionFactor"),
    "both": (
        _transmits(0.5, 0.4),
        F + 0.3 * COLOR - 0.2 * F,
        0.5 * (1 - F) * COLOR + [0.2, 0, 0],
        "gloss of diffuseTransmissionFactor",
    ),
    "solid leaf": (_transmits(spread=0.4, solid={"thicknessFactor": 1.0}), F + COLOR, 0.0, "diffuseTransmissionFactor"),
}


@pytest.mark.parametrize("of", PASSED)
def test_walls_pass_light_by_their_factors_and_colours_of_both_sides(of: str, tmp_path: Path) -> None:
    parts, reflected, transmitted, told = PASSED[of]
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        surface = mi.load_dict(gltf_scene(_glb(tmp_path, {}, parts=parts))["material skin"])
    assert [str(w.message).split("it: ")[1] for w in warned] == ([f"{told} (skin)"] if told else [])
    si, random = dr.zeros(mi.SurfaceInteraction3f, 2**18), mi.PCG32(2**18)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    for side in (1.0, -1.0):
        si.wi = mi.Vector3f(math.sqrt(1 - 0.49), 0, side * 0.7)
        u = mi.Point2f(random.next_float32(), random.next_float32())
        sample, weight = surface.sample(mi.BSDFContext(), si, random.next_float32(), u)
        found = [np.ravel(dr.mean(weight & (sample.wo.z * way > 0), axis=1)) for way in (side, -side)]
        np.testing.assert_allclose(found, [reflected + np.zeros(3), transmitted + np.zeros(3)], atol=0.02)


HALF = gltf.PbrMetallicRoughness(baseColorFactor=[1.0, 1.0, 1.0, 0.5])
NEAR = {"textures": [gltf.Texture(source=0, sampler=0)], "samplers": [gltf.Sampler(magFilter=9728, wrapS=33071)]}
BARE = gltf.Primitive(attributes=gltf.Attributes(POSITION=0, NORMAL=1), indices=3)
FACE = gltf.Primitive(attributes=gltf.Attributes(POSITION=0), indices=None, material=0)
PLAIN = gltf.Primitive(attributes=gltf.Attributes(POSITION=0, NORMAL=1), indices=3, material=0)
GLOW = {"emissiveFactor": [1.0, 0.5, 0.2], "doubleSided": True}
EVEN = {"spot": {"innerConeAngle": 0.5, "outerConeAngle": 0.5}}
TOLD = {  # changes: what is not taken
    "extension": ({"extensionsUsed": ["KHR_materials_variants"]}, "KHR_materials_variants"),
    "range": ({"extensions": {"KHR_lights_punctual": {"lights": [{"type": "point", "range": 2.0}]}}}, "range of Light"),
    "spot": ({"extensions": {"KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {"innerConeAngle": 0.5}}]}}},
             "falloff between the angles of Light"),
    "even spot": ({"extensions": {"KHR_lights_punctual": {"lights": [{"type": "spot", **EVEN}]}}}, ""),
    "wrap": ({**NEAR, "textured": True}, "wrapT of sampler 0"),
    "object": (
        {"meshes": [gltf.Mesh(primitives=[BARE], extras={"sss_mfp": 1.0})]},
        "sss_mfp of Ball.001, which is no material",
    ),
    "back": ({"meshes": [gltf.Mesh(primitives=[FACE])], "look": GLOW}, "light of Ball.001 behind its faces"),
    "closed": ({"look": GLOW}, ""),
    "uv": ({"meshes": [gltf.Mesh(primitives=[PLAIN])], "textured": True}, "textures of Ball.001, which has no uv"),
    "no texture": ({"meshes": [gltf.Mesh(primitives=[PLAIN])]}, ""),
    "ior": ({"parts": {**_transmits(1.0, solid=VOLUME), "KHR_materials_specular": {"specularFactor": 0.5}}},
            "specularFactor (skin), roughness (skin), base color (skin)"),
}  # fmt: skip


@pytest.mark.parametrize("of", TOLD)
def test_what_changes_the_picture_and_is_not_taken_is_told(of: str, tmp_path: Path) -> None:
    changes, told = TOLD[of]
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        scene = gltf_scene(_glb(tmp_path, {}, **changes))
    assert [str(w.message).split("it: ")[1] for w in warned] == ([told] if told else [])
    if of == "wrap":
        assert scene["material skin"]["bsdf"]["base_color"]["filter_type"] == "nearest"
    if of == "uv":
        assert not np.array(
            mi.traverse(mi.load_dict(scene["Ball_001"] | {"bsdf": {"type": "null"}}))["vertex_texcoords"]
        ).any()
    if of == "object":  # a mesh without a material is white rough metal
        assert scene["material none"]["bsdf"]["metallic"] == scene["material none"]["bsdf"]["roughness"] == 1


@pytest.mark.filterwarnings("ignore")
def test_alpha_hides_what_a_surface_emits_and_factors_share_coloured_glass(tmp_path: Path) -> None:
    look = {"alphaMode": "BLEND", "pbrMetallicRoughness": HALF, "emissiveFactor": [1.0, 0.5, 0.2]}
    scene = gltf_scene(_glb(tmp_path, {}, look=look))
    assert scene["Ball_001"]["emitter"]["radiance"]["value"] == [0.5, 0.25, 0.1]
    glass = gltf_scene(_glb(tmp_path, {}, parts=_transmits(0.25, solid=VOLUME)))["material skin"]
    assert (glass["weight"], glass["bsdf_1"]["type"]) == (0.25, "translucent")


LIGHTS = {
    "directional": {"intensity": 1.0},
    "spot": {"intensity": 683 * 0.04, "spot": {"outerConeAngle": 0.5, "innerConeAngle": 0.5}},
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", LIGHTS)
def test_lights_have_one_watt_below_them(kind: str, tmp_path: Path) -> None:
    lights = {"KHR_lights_punctual": {"lights": [{"type": kind, **LIGHTS[kind]}]}}
    lamp = mi.load_dict(gltf_scene(_glb(tmp_path, extensions=lights))["Light"])
    lamp.set_scene(mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}}))
    si = mi.SurfaceInteraction3f()
    si.p = mi.Point3f([0.1, 0.4], [0.1, 0.1], [0.2, 0.2])  # 0.2 m below, and beside the cone
    sampled, weight = lamp.sample_direction(si, mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(sampled.d)[:, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(np.array(weight)[0] * np.ones(2), [1, kind == "directional"], rtol=1e-5)


@pytest.mark.filterwarnings("ignore")
def test_a_map_beside_the_file_has_its_middle_where_blender_has_it(tmp_path: Path) -> None:
    texels = np.zeros((8, 16, 3), dtype=np.float32)
    texels[:, 7:9], texels[:, 3:5] = 1.0, 2.0
    mi.Bitmap(texels).write(str(tmp_path / "ball.exr"))
    sky, si = mi.load_dict(gltf_scene(_glb(tmp_path))["sky"]), mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f([1, 0, -1, 0], [0, 0, 0, 0], [0, -1, 0, 1])  # +x of Blender, its +y, -x, -y
    np.testing.assert_allclose(np.array(sky.eval(si))[0], [1, 2, 0, 0], atol=0.01)


IMAGE = gltf.TextureInfo(index=0, extensions={"KHR_texture_transform": {"scale": [2.0, 2.0], "offset": [0.5, 0.0]}})
LOOKS = {  # what of a material, extensions: BSDFs from the outside
    "glass": (
        {},
        {"KHR_materials_transmission": {"transmissionFactor": 1.0}, "KHR_materials_volume": {"thicknessFactor": 1.0}},
        "principled",
    ),
    "pane": ({}, {"KHR_materials_transmission": {"transmissionFactor": 1.0}}, "principledthin"),
    "leaf": ({}, {"KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.5}}, "blendbsdf"),
    "bumps": ({"normalTexture": gltf.NormalMaterialTexture(index=0, scale=0.5)}, {}, "twosided normalmap principled"),
    "holes": ({"alphaMode": "MASK"}, {}, "mask twosided principled"),
    "lamp": ({"emissiveFactor": [1.0, 0.5, 0.2], "emissiveTexture": IMAGE}, {}, "twosided principled"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("of", LOOKS)
def test_looks_become_surfaces_of_mitsuba(of: str, tmp_path: Path) -> None:
    look, parts, wanted = LOOKS[of]
    scene = gltf_scene(_glb(tmp_path, {}, parts=parts, look=look, textured=True))
    surface, found = scene["material skin"], []
    while surface:
        found.append(surface["type"])
        surface = surface.get("bsdf")
    assert " ".join(found) == wanted
    assert ("emitter" in scene["Ball_001"]) is (of == "lamp")
    mi.load_dict(scene)
    if of == "lamp":
        texture, si = mi.load_dict(scene["Ball_001"]["emitter"]["radiance"]), mi.SurfaceInteraction3f()
        si.uv = mi.Point2f(0.125, 0.125)  # the green texel is there by 2 u + 0.5 and 2 v
        np.testing.assert_allclose(np.array(texture.eval(si)).T, [[0, 0.5, 0]], atol=1e-5)


MISSING = gltf.Buffer(uri="none.bin", byteLength=10)
REFUSED = [
    (
        {"extensionsRequired": ["KHR_draco_mesh_compression"]},
        "must not need KHR_draco_mesh_compression: export it without",
    ),
    ({"extensionsUsed": ["EXT_meshopt_compression"]}, "must not need EXT_meshopt_compression"),
    ({"buffers": [MISSING]}, "a file that it needs must be beside it, got no none.bin"),
    (
        {"buffers": [gltf.Buffer(uri="data:application/octet-stream;base64,AAAA", byteLength=9)]},
        "buffer 0 must have 9 bytes, got 3",
    ),
    (
        {"accessors": [gltf.Accessor(componentType=5126, count=6, type="VEC3", sparse=gltf.Sparse())]},
        "got accessor 0, which is sparse",
    ),
    ({"scenes": [gltf.Scene(nodes=[0])]}, "must have a camera, got none"),
    ({"accessors": []}, "must be a valid glTF file, got IndexError"),
    ({"color": (1.5, 0.5, 0.5)}, "reflectance"),
    ({"parts": {"KHR_materials_ior": {"ior": 0.0}}}, "material 'skin': ior must be at least 1, got 0"),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_files_that_are_no_scene_are_refused(changes: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        open_scene(_glb(tmp_path, **changes))


@pytest.mark.parametrize("suffix", ["usda", "blend"])
def test_a_file_of_another_format_is_refused_with_what_to_export(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"scene.{suffix}"
    path.write_text("#usda 1.0")
    with pytest.raises(ValueError, match=rf"scene must be an XML or glTF file, got .*{suffix}': export it as glTF 2.0"):
        open_scene(path)
