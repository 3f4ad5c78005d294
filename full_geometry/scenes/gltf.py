"""Scenes of glTF 2.0 (.glb, .gltf) with units of a metre, as Blender 4 and 5 write them, as dicts for Mitsuba."""

from __future__ import annotations

import functools
import hashlib
import math
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from halfspace_sss import materials
from halfspace_sss.materials.imports import gltf_medium, modulated, read_gltf
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import half_space_reflectance

if TYPE_CHECKING:
    import pygltflib

SUFFIXES = (".glb", ".gltf")
MM_PER_METRE = 1000.0
LUMENS_PER_WATT = 683.0  # by which Blender multiplies points and spots, and no suns
PIXELS = 1024  # of the longer side of an image, where the camera does not say
TRIANGLES, NEAREST = 4, 9728
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
EMITTERS = ("point", "spot", "directional", "envmap")
WRAPS = {None: "repeat", 10497: "repeat", 33071: "clamp", 33648: "mirror"}
TINTS = ("diffuseTransmissionColorTexture", "diffuseTransmissionColorFactor")
TAKEN = {  # extensions, with what of them is taken
    "KHR_lights_punctual": (), "KHR_texture_transform": (), "KHR_materials_ior": ("ior",),
    "KHR_materials_specular": ("specularFactor",), "KHR_materials_transmission": ("transmissionFactor",),
    "KHR_materials_volume": ("thicknessFactor", "attenuationDistance", "attenuationColor"),
    "KHR_materials_volume_scatter": ("multiscatterColor", "multiscatterColorFactor", "scatterAnisotropy"),
    "KHR_materials_diffuse_transmission": ("diffuseTransmissionFactor", *TINTS),
    "KHR_materials_emissive_strength": ("emissiveStrength",),
}  # fmt: skip
TURN = np.diag([-1.0, 1.0, -1.0, 1.0])  # glTF looks along -z with x to the right, Mitsuba along z
SKY = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # Blender's map has +x in its middle


def is_gltf(scene: object) -> bool:
    """Whether a scene is the path of a glTF file."""
    return isinstance(scene, str | Path) and Path(scene).suffix.lower() in SUFFIXES


def gltf_scene(path: Path) -> dict[str, Any]:
    """A dict for Mitsuba with the meshes, cameras, lights and materials of a glTF file, in metres.

    A map of the same stem beside it, .hdr or .exr, becomes the environment, as Blender turns it. Custom properties
    (`extras`) of a material whose names begin with sss_ make it `translucent`: the rest of a name is a parameter of
    that surface, lengths in mm; the base colour stands for `reflectance` where `mfp` is given alone. sss_radius and
    sss_scale are those of Blender's Principled BSDF in metres, sss_alpha is a rough boundary, and sss_weight blends it
    with the surface that the material has without, as the subsurface weight of OpenPBR does. Lights are in W/sr
    and W/m², as Blender's lighting mode "Standard" has them. One warning names all that is not taken.

    Raises:
        ValueError: the file cannot be read, needs what is not known here (compressed meshes), lacks a buffer or an
            image, or has sparse accessors, other sets of uv, or values that no medium has.
        BackendError: pygltflib is not installed.
    """
    file = _File(path)
    try:
        result = file.scene()
    except (IndexError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: must be a valid glTF file, got {type(error).__name__}: {error}") from error
    if file.not_taken:
        warnings.warn(f"{path}: not taken from it: {', '.join(dict.fromkeys(file.not_taken))}", stacklevel=2)
    return result


@functools.cache
def _folder() -> tempfile.TemporaryDirectory:
    """Where meshes are until this process ends: Mitsuba reads them from files alone."""
    return tempfile.TemporaryDirectory(prefix="halfspace-sss-")


class _File:
    """A glTF file while it becomes a scene."""

    def __init__(self, path: Path) -> None:
        self.path, self.doc, self.not_taken = path, read_gltf(path), []
        unit = {"type": "translucent_walk", "mm_per_unit": MM_PER_METRE}
        self.results: dict[str, Any] = {"type": "scene", "integrator": unit}
        self.looks: dict[int, str] = {}  # names of surfaces by numbers of materials
        for name in sorted({*(self.doc.extensionsRequired or ()), *(self.doc.extensionsUsed or ())}):
            if name in (self.doc.extensionsRequired or ()) and name not in TAKEN or "compression" in name:
                raise ValueError(f"{path}: must not need {name}: export it without")
        self.not_taken += [name for name in ("animations", "skins") if getattr(self.doc, name)]

    def scene(self) -> dict[str, Any]:
        for root in self.doc.scenes[self.doc.scene or 0].nodes:
            for node, place in self._nodes(root, np.eye(4)):
                self._add(node, place)
        maps = [path for path in map(self.path.with_suffix, (".hdr", ".exr")) if path.is_file()]
        if maps:
            turn = mi.ScalarTransform4f(SKY)
            self._put("sky", {"type": "envmap", "filename": str(maps[0]), "to_world": turn})
        for name in self.doc.extensionsUsed or ():
            if name not in TAKEN and not any(name in told for told in self.not_taken):
                self.not_taken.append(name)
        parts = [part for part in self.results.values() if isinstance(part, dict)]
        if not any("emitter" in part or part["type"] in EMITTERS for part in parts):
            self.not_taken.append("no light, so that the sky is white")
            self._put("sky", {"type": "constant"})
        if not any(part["type"] == "perspective" for part in parts):
            raise ValueError(f"{self.path}: must have a camera, got none: export it with its cameras")
        return self.results

    def _nodes(self, index: int, parent: np.ndarray) -> Iterator[tuple[pygltflib.Node, np.ndarray]]:
        node = self.doc.nodes[index]
        place = parent @ _local(node)
        yield node, place
        for child in node.children or ():
            yield from self._nodes(child, place)

    def _put(self, name: str, part: dict[str, Any]) -> str:
        """Add a part of the scene under a name that Mitsuba takes and no other has."""
        name = (name or part["type"]).replace(".", "_")
        names = (name, *(f"{name}_{k}" for k in range(1, len(self.results) + 1)))
        name = next(each for each in names if each not in self.results)
        self.results[name] = part
        return name

    def _add(self, node: pygltflib.Node, place: np.ndarray) -> None:
        parts = node.extensions or {}
        self.not_taken += [name for name in parts if name not in TAKEN]
        owners = [node] if node.mesh is None else [node, self.doc.meshes[node.mesh]]
        said = [key for owner in owners for key in owner.extras or {} if key.startswith("sss_")]
        self.not_taken += [f"{key} of {node.name}, which is no material" for key in said]
        if node.camera is not None:
            self._put(node.name, self._camera(node, place))
        if "KHR_lights_punctual" in parts:
            light = self.doc.extensions["KHR_lights_punctual"]["lights"][parts["KHR_lights_punctual"]["light"]]
            inner, outer = _cone(light)
            told = {"range": "range" in light, "falloff between the angles": light["type"] == "spot" and inner < outer}
            self.not_taken += [f"{what} of {node.name}" for what, there in told.items() if there]
            self._put(node.name, _light(light, place))
        for primitive in self.doc.meshes[node.mesh].primitives if node.mesh is not None else ():
            triangles = primitive.mode in (None, TRIANGLES)
            colored = getattr(primitive.attributes, "COLOR_0", None) is not None
            wrong = {
                "points, lines or strips": not triangles,
                "shape keys": primitive.targets,
                "colours of vertices": colored,
            }
            self.not_taken += [f"{what} of {node.name}" for what, there in wrong.items() if there]
            if triangles:
                look = self._look(primitive.material)
                self._put(node.name, self._mesh(primitive, node, place) | look)

    def _camera(self, node: pygltflib.Node, place: np.ndarray) -> dict[str, Any]:
        camera = self.doc.cameras[node.camera]
        seen = camera.perspective
        if camera.type != "perspective":
            raise ValueError(f"{self.path}: cameras must be perspective, got {camera.type} of {node.name!r}")
        aspect, said = seen.aspectRatio or 1.0, {**(camera.extras or {}), **(node.extras or {})}
        width = int(said.get("width", round(PIXELS * min(aspect, 1.0))))
        height = int(said.get("height", max(round(width / aspect), 1)))
        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        seen_from = {"to_world": _turned(place), "near_clip": seen.znear, "far_clip": seen.zfar or 1e4}
        return {"type": "perspective", "fov": math.degrees(seen.yfov), "fov_axis": "y", **seen_from, "film": film}

    # ---- meshes

    def _mesh(self, primitive: pygltflib.Primitive, node: pygltflib.Node, place: np.ndarray) -> dict[str, Any]:
        """A file with the mesh where it stands."""
        has, linear = primitive.attributes, place[:3, :3]
        vertices = [self._array(has.POSITION) @ linear.T + place[:3, 3]]
        names, count = ["x", "y", "z"], len(vertices[0])
        if has.NORMAL is not None:
            turned = self._array(has.NORMAL) @ np.linalg.inv(linear)
            vertices.append(turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30))
            names += ["nx", "ny", "nz"]
        material = self._material(primitive.material)
        if has.TEXCOORD_0 is not None or _is_textured(material):
            # without uv a texture shows its value at 0; of itself Mitsuba would repeat it on each face
            self.not_taken += [f"textures of {node.name}, which has no uv"] if has.TEXCOORD_0 is None else []
            vertices.append(np.zeros((count, 2)) if has.TEXCOORD_0 is None else self._array(has.TEXCOORD_0))
            names += ["u", "v"]
        faces = np.arange(count) if primitive.indices is None else self._array(primitive.indices).astype(int)
        faces = faces.reshape(-1, 3)[:, :: 1 if np.linalg.det(linear) > 0 else -1]
        lit_behind = material.doubleSided and any(material.emissiveFactor or ()) and _is_open(vertices[0][faces])
        bent = material.normalTexture is not None and has.TEXCOORD_0 is not None and _is_mirrored(vertices[-1][faces])
        self.not_taken += [f"light of {node.name} behind its faces"] if lit_behind else []
        self.not_taken += [f"mirrored uv of {node.name} under its normalTexture"] if bent else []
        lists = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3)])
        lists["n"], lists["v"] = 3, faces
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
        lines += [f"property float {name}" for name in names]
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
        data = "\n".join(lines).encode() + np.hstack(vertices).astype("<f4").tobytes() + lists.tobytes()
        path = Path(_folder().name) / f"{hashlib.sha256(data).hexdigest()[:16]}.ply"
        path.write_bytes(data)
        return {"type": "ply", "filename": str(path), "face_normals": has.NORMAL is None}

    def _array(self, index: int) -> np.ndarray:
        """The values of an accessor, as floats (count, width)."""
        accessor = self.doc.accessors[index]
        if accessor.sparse is not None or accessor.bufferView is None:
            raise ValueError(f"{self.path}: accessors must be whole, got accessor {index}, which is sparse")
        kind, width = np.dtype(COMPONENTS[accessor.componentType]), WIDTHS[accessor.type]
        view = self.doc.bufferViews[accessor.bufferView]
        strides = (view.byteStride or width * kind.itemsize, kind.itemsize)
        data = self._view(accessor.bufferView)
        values = np.ndarray((accessor.count, width), kind, data, accessor.byteOffset or 0, strides).astype(float)
        return values / np.iinfo(kind).max if accessor.normalized else values

    def _view(self, index: int) -> bytes:
        view = self.doc.bufferViews[index]
        start, buffer = view.byteOffset or 0, self.doc.buffers[view.buffer]
        data = (self.doc.binary_blob() or b"") if buffer.uri is None else self._read(buffer.uri)
        if len(data) < buffer.byteLength:
            raise ValueError(f"{self.path}: buffer {view.buffer} must have {buffer.byteLength} bytes, got {len(data)}")
        return data[start : start + view.byteLength]

    def _read(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return self.doc.get_data_from_buffer_uri(uri)
        file = self.path.parent / unquote(uri)
        if not file.is_file():
            raise ValueError(f"{self.path}: a file that it needs must be beside it, got no {uri}")
        return file.read_bytes()

    # ---- materials

    def _material(self, index: int | None) -> pygltflib.Material:
        """A material, or that of meshes without one: white rough metal."""
        if index is not None:
            return self.doc.materials[index]
        import pygltflib

        return pygltflib.Material(name="none")

    def _look(self, index: int | None) -> dict[str, Any]:
        """The surface of a material, by its name in the scene, and what it emits."""
        material = self._material(index)
        try:
            if index not in self.looks:
                surface = self._masked(material, self._surface(material))
                self.looks[index] = self._put(f"material {material.name or index}", surface)
        except ValueError as error:
            raise ValueError(f"{self.path}: material {material.name!r}: {error}") from error
        parts, result = material.extensions or {}, {"bsdf": {"type": "ref", "id": self.looks[index]}}
        factor = np.array(material.emissiveFactor or (0.0, 0.0, 0.0))
        if factor.any():
            factor = factor * parts.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
            result["emitter"] = {"type": "area", "radiance": self._emitted(material, factor)}
        return result

    def _emitted(self, material: pygltflib.Material, factor: np.ndarray) -> dict[str, Any]:
        """What a material emits, times its alpha: Mitsuba's masks hide no emitter."""
        texture, opacity = material.emissiveTexture, self._opacity(material)
        if np.ndim(opacity) == 0:
            return self._color(texture, factor * (1.0 if opacity is None else opacity))
        if texture is None:
            return self._bitmap(material.pbrMetallicRoughness.baseColorTexture, opacity * factor, raw=False)
        self.not_taken.append(f"alpha of emissiveTexture ({material.name})")
        return self._color(texture, factor)

    def _surface(self, material: pygltflib.Material) -> dict[str, Any]:
        parts, pbr = material.extensions or {}, material.pbrMetallicRoughness
        color, texture, metallic, roughness, rough = (1.0,) * 3, None, 1.0, 1.0, None
        if pbr is not None:
            color = (pbr.baseColorFactor or color)[:3]
            texture, rough = pbr.baseColorTexture, pbr.metallicRoughnessTexture
            metallic, roughness = (1.0 if v is None else v for v in (pbr.metallicFactor, pbr.roughnessFactor))
        told: dict[str, Any] = {key: True for key in parts if key not in TAKEN}
        told |= {f"{key} of {name}": True for name in TAKEN for key in parts.get(name, ()) if key not in TAKEN[name]}
        get = {key: value for name in parts.keys() & TAKEN for key, value in parts[name].items()}
        ior, specular, clear = get.get("ior", 1.5), get.get("specularFactor", 1.0), get.get("transmissionFactor", 0.0)
        if not ior >= 1:
            raise ValueError(f"ior must be at least 1, got {ior!r}")
        solid, leaf = get.get("thicknessFactor", 0.0) > 0, get.get("diffuseTransmissionFactor", 0.0)
        refracts = solid and bool(clear or "KHR_materials_volume_scatter" in parts)
        eta = max(ior if refracts else modulated(ior, specular), 1.0001)
        told |= {"occlusionTexture": material.occlusionTexture, "specularFactor": refracts and specular != 1}
        base, given = self._color(texture, np.array(color)), _given(material)
        shown = {"eta": eta, "base_color": base, "roughness": self._gray(rough, 1, roughness)}
        opaque = {"type": "principled", **shown, "metallic": self._gray(rough, 2, metallic)}
        medium = None if given else _medium(parts, get, eta)
        if given or medium:
            weight = given.pop("weight", 1.0) if given or not (clear or leaf) else 1 - (1 - clear) * (1 - leaf)
            if not (isinstance(weight, float | int) and 0 < weight <= 1):
                raise ValueError(f"sss_weight must be a number in (0, 1], got {weight!r}")
            inside = _translucent(given, medium, base, eta)
            told |= {
                "roughness": roughness and ("bsdf" not in inside or rough is not None), "metallic": metallic,
                "transmissionFactor": given and clear, "diffuseTransmissionFactor": given and leaf,
                "diffuseTransmissionColorFactor": medium and leaf and get.keys() & TINTS,
                "base color": base.get("value") != [1.0] * 3 and not given.keys() & {"radius", "mfp"} and weight == 1,
            }  # fmt: skip
            shares = {"principled": (1 - weight, opaque), "translucent": (weight, inside)}
        elif solid:
            told["diffuseTransmissionFactor"] = leaf
            shares = {"glass": (1.0, opaque | {"spec_trans": clear})} if clear else {"opaque": (1.0, opaque)}
        else:
            told |= {"texture of metallic": rough and (clear or leaf), "gloss of diffuseTransmissionFactor": leaf}
            other = 1.0 if rough else 1 - metallic
            through, spread = other * clear, other * (1 - clear) * leaf
            pane = {"type": "principledthin", "spec_trans": 1.0, **shown}
            behind = {"type": "principledthin", "base_color": self._behind(get), "diff_trans": 2.0}
            shares = {"opaque": (1 - through - spread, opaque), "leaf": (spread, behind), "pane": (through, pane)}
        self.not_taken += [f"{key} ({material.name})" for key, there in told.items() if there]
        bent = {name: (share, self._bent(material, part)) for name, (share, part) in shares.items() if share > 0}
        if "opaque" in bent:
            bent["opaque"] = bent["opaque"][0], {"type": "twosided", "bsdf": bent["opaque"][1]}
        return _mixed(list(bent.values()))

    def _behind(self, get: dict[str, Any]) -> dict[str, Any]:
        """The colour of light that a thin wall spreads behind it."""
        texture, factor = (get.get(key) for key in TINTS)
        if texture is not None:
            import pygltflib

            texture = pygltflib.TextureInfo(**texture)
        return self._color(texture, np.array(factor or (1.0, 1.0, 1.0)))

    def _bent(self, material: pygltflib.Material, surface: dict[str, Any]) -> dict[str, Any]:
        """A surface with the normals of its material."""
        bump = material.normalTexture
        if bump is None:
            return surface
        pixels = 0.5 + (self._pixels(bump.index, raw=True)[..., :3] - 0.5) * [*(bump.scale or 1.0,) * 2, 1.0]
        return {"type": "normalmap", "normalmap": self._bitmap(bump, pixels, raw=True), "bsdf": surface}

    def _masked(self, material: pygltflib.Material, surface: dict[str, Any]) -> dict[str, Any]:
        """The surface behind the alpha of its base colour."""
        opacity = self._opacity(material)
        if opacity is None:
            return surface
        if np.ndim(opacity):
            opacity = self._bitmap(material.pbrMetallicRoughness.baseColorTexture, opacity, raw=True)
        return {"type": "mask", "opacity": opacity, "bsdf": surface}

    def _opacity(self, material: pygltflib.Material) -> np.ndarray | float | None:
        """The alpha of a base colour that counts: a number, or its texels (height, width, 1)."""
        pbr = material.pbrMetallicRoughness
        if material.alphaMode in (None, "OPAQUE") or pbr is None:
            return None
        texture, opacity = pbr.baseColorTexture, (pbr.baseColorFactor or (1.0,) * 4)[3]
        if texture is not None:
            opacity = opacity * self._pixels(texture.index, raw=True)[..., 3:]
        if material.alphaMode == "MASK":
            opacity = 1.0 * (opacity >= (0.5 if material.alphaCutoff is None else material.alphaCutoff))
        return opacity

    def _color(self, texture: pygltflib.TextureInfo | None, factor: np.ndarray) -> dict[str, Any]:
        """A colour, or a texture times a colour, linear."""
        if texture is None:
            return {"type": "rgb", "value": factor.tolist()}
        return self._bitmap(texture, self._pixels(texture.index, raw=False)[..., :3] * factor, raw=False)

    def _gray(self, texture: pygltflib.TextureInfo | None, channel: int, factor: float) -> dict[str, Any] | float:
        if texture is None or factor == 0:
            return float(factor)
        pixels = factor * self._pixels(texture.index, raw=True)[..., channel : channel + 1]
        return self._bitmap(texture, pixels, raw=True)

    def _pixels(self, index: int, raw: bool) -> np.ndarray:
        """The values of an image, with four channels: as they are stored, in [0, 1], or made linear from sRGB."""
        source = self.doc.textures[index].source
        if source is None:
            raise ValueError("images must be PNG or JPEG, got another kind")
        image, stream = self.doc.images[source], mi.MemoryStream()
        stream.write(self._view(image.bufferView) if image.uri is None else self._read(image.uri))
        stream.seek(0)
        bitmap = mi.Bitmap(stream)
        bitmap.set_srgb_gamma(not raw)
        return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.Float32, False))

    def _bitmap(self, texture: pygltflib.TextureInfo, pixels: np.ndarray, raw: bool) -> dict[str, Any]:
        """A texture of Mitsuba with the coordinates of one of glTF."""
        turned = (texture.extensions or {}).get("KHR_texture_transform", {})
        if turned.get("texCoord", texture.texCoord or 0) != 0:
            raise ValueError("textures must use the first set of uv, got another")
        result = {"type": "bitmap", "bitmap": mi.Bitmap(pixels.astype(np.float32)), "raw": raw}
        number = self.doc.textures[texture.index].sampler
        if number is not None:
            sampler = self.doc.samplers[number]
            wrap = WRAPS[sampler.wrapS]
            self.not_taken += [f"wrapT of sampler {number}"] if WRAPS[sampler.wrapT] != wrap else []
            result |= {"wrap_mode": wrap, "filter_type": "nearest" if sampler.magFilter == NEAREST else "bilinear"}
        if turned:
            angle, to_uv = turned.get("rotation", 0.0), np.eye(4)
            spun = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
            to_uv[:2, :2], to_uv[:2, 3] = spun * turned.get("scale", (1.0, 1.0)), turned.get("offset", (0.0, 0.0))
            result["to_uv"] = mi.ScalarTransform4f(to_uv)
        return result


def _translucent(given: dict[str, Any], medium: Medium | None, base: dict[str, Any], eta: float) -> dict[str, Any]:
    """The surface `translucent` by custom properties without their sss_, or by a medium of the file."""
    given, alpha = dict(given), given.get("alpha", 0.0)
    given.pop("alpha", None)
    if medium is None and "material" not in given and "spectra" not in given:
        eta = given.setdefault("eta", eta)
    if "radius" in given:
        radius, scale, g = np.array(given.pop("radius")), given.pop("scale", 0.05), given.get("g", 0.0)
        if base["type"] == "rgb":
            medium = Medium.from_principled(base["value"], radius, scale, g, eta)
        else:  # the light that enters and leaves again, as in `Medium.from_openpbr`, taken for that under even light
            enters = half_space_reflectance(1.0, 0.0, eta, 1.0)
            base = base | {"bitmap": mi.Bitmap(np.array(base["bitmap"]) * np.float32(enters))}
            given |= {"reflectance": base, "mfp": MM_PER_METRE * scale * (1 - g) / (4 * np.pi) * radius}
    elif "mfp" in given:
        given.setdefault("reflectance", _text(base["value"]) if base["type"] == "rgb" else base)
    if medium is not None:
        given |= {key: _text(getattr(medium, key)) for key in ("sigma_s", "sigma_a", "g")} | {"eta": medium.eta}
    result = {"type": "translucent", **{key: _text(value) for key, value in given.items()}}
    if alpha:
        index = float(materials.load(given["material"]).medium.eta if "material" in given else given["eta"])
        result["bsdf"] = {"type": "roughdielectric", "alpha": alpha, "int_ior": index, "ext_ior": 1.0}
    return result


def _is_textured(material: pygltflib.Material) -> bool:
    pbr = material.pbrMetallicRoughness
    parts = [vars(material), vars(pbr) if pbr else {}, *(material.extensions or {}).values()]
    return any(name.endswith("Texture") and value is not None for part in parts for name, value in part.items())


def _given(material: pygltflib.Material) -> dict[str, Any]:
    """Custom properties without their sss_."""
    return {key[4:]: value for key, value in (material.extras or {}).items() if key.startswith("sss_")}


def _medium(parts: dict[str, dict[str, Any]], get: dict[str, Any], eta: float) -> Medium | None:
    """The medium of a material by its extensions, and their values: scattering, or clear and coloured."""
    medium, distance = gltf_medium(parts), get.get("attenuationDistance", math.inf)
    clear = get.get("thicknessFactor", 0.0) > 0 and get.get("transmissionFactor", 0.0) > 0 and distance < math.inf
    if medium is not None or not clear:
        return medium
    depth = -np.log(get.get("attenuationColor", (1.0, 1.0, 1.0)))
    return Medium((0.0,) * 3, depth / (MM_PER_METRE * distance), 0.0, eta)


def _mixed(shares: list[tuple[float, dict[str, Any]]]) -> dict[str, Any]:
    """Surfaces by their shares, of which the sum is 1."""
    (whole, result), *others = shares
    for share, part in others:
        whole += share
        result = {"type": "blendbsdf", "weight": share / whole, "bsdf_0": result, "bsdf_1": part}
    return result


def _is_open(faces: np.ndarray) -> bool:
    """Whether triangles, shape (n, 3, 3), have an edge of one alone."""
    _, corners = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)
    corners = corners.reshape(-1, 3)
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 1).any())


def _is_mirrored(uv: np.ndarray) -> bool:
    """Whether textures are mirrored on any triangle, whose uv have the shape (n, 3, 2), with v downwards."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return bool((a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0]).any())


def _text(value: object) -> object:
    """A value as the surface takes it: several numbers as a string."""
    if isinstance(value, str | bool | dict):
        return value
    return ", ".join(repr(float(v)) for v in np.ravel(value)) if np.size(value) > 1 else float(np.ravel(value)[0])


def _local(node: pygltflib.Node) -> np.ndarray:
    """The matrix of a node in its parent."""
    if node.matrix is not None:
        return np.array(node.matrix, dtype=float).reshape(4, 4).T
    result, turned = np.eye(4), Rotation.from_quat(node.rotation or (0.0, 0.0, 0.0, 1.0))
    result[:3, :3] = turned.as_matrix() * (node.scale or (1.0, 1.0, 1.0))
    result[:3, 3] = node.translation or (0.0, 0.0, 0.0)
    return result


def _light(light: dict[str, Any], place: np.ndarray) -> dict[str, Any]:
    """A light in W/sr, or a sun in W/m²."""
    sun = light["type"] == "directional"
    power = light.get("intensity", 1.0) / (1.0 if sun else LUMENS_PER_WATT)
    strength = {"type": "rgb", "value": [power * c for c in light.get("color", (1.0, 1.0, 1.0))]}
    if sun:
        return {"type": "directional", "direction": (-place[:3, 2]).tolist(), "irradiance": strength}
    if light["type"] == "point":
        return {"type": "point", "position": place[:3, 3].tolist(), "intensity": strength}
    inner, outer = map(math.degrees, _cone(light))  # between them glTF has a square of cosines, Mitsuba the angle
    return {
        "type": "spot", "to_world": _turned(place), "intensity": strength, "cutoff_angle": outer, "beam_width": inner,
    }  # fmt: skip


def _cone(light: dict[str, Any]) -> tuple[float, float]:
    """The inner and the outer angle of a spot."""
    spot = light.get("spot", {})
    return spot.get("innerConeAngle", 0.0), spot.get("outerConeAngle", math.pi / 4)


def _turned(place: np.ndarray) -> mi.ScalarTransform4f:
    """Where a camera or a spot stands, without the scale of its node."""
    return mi.ScalarTransform4f(place / [*np.linalg.norm(place[:3, :3], axis=0), 1.0] @ TURN)
