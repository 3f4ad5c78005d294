"""Media by textures of the surface: albedo and extinction, or reflectance and mean free path, at a point of it.

A medium below a surface has no texture: a value per point of the surface is a convention. The walk takes the medium of
the exit, the point that the camera sees, for its whole way, as Cycles, Arnold and RenderMan do.

    albedo, sigma_t = A(x), scale T(x)    or    a(R(x)), scale / l(x)

A, T, R and l are Mitsuba's textures or numbers; a(R) is the albedo whose half-space has the reflectance R, tabulated.
The mean cosine and the relative index are constant.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.points import MediumAt, SurfacePoint, opaque
from full_geometry.geometry.shape import Geometry, name_of
from halfspace_sss.physics.medium import Medium, diffuse_limit
from halfspace_sss.physics.reflectance import albedo_of_reflectance, half_space_reflectance

NODES = 1025  # of the table of x by reflectance
BY_UV = ("BitmapTexture", "Checkerboard")
KNOWN = (*BY_UV, "MeshAttribute", "UniformSpectrum", "SRGBReflectanceSpectrum")  # of which all values are known
LUMINANCE = np.array([[0.212671], [0.715160], [0.072169]])  # of linear sRGB, as Mitsuba has it
Number = "mi.Float | np.ndarray | float"
UNKNOWN = {"albedo": 0.5, "reflectance": 0.2, "sigma_t": 1.0, "mfp": 1.0}  # means of attributes before a mesh is known


class AlbedoTable:
    """The albedo a(R) of half-spaces of one index, from x of `physics.reflectance` over sqrt(R / most).
    `g`: mean cosine of each channel. `eta`: relative index. `most`: reflectance of albedo 1 of each channel; a(R) = 1
    above it."""

    def __init__(self, g: list[float], eta: float) -> None:
        most = {each: half_space_reflectance(1.0, each, eta) for each in set(g)}
        self.g, self.most, self.tables = g, np.array([most[each] for each in g]), {}
        for each, top in most.items():
            albedo = albedo_of_reflectance(top * np.linspace(0, 1, NODES) ** 2, each, eta)
            x = mi.TensorXf(x_of_albedo(np, albedo, each, bend(each)).astype(np.float32)[:, None])
            self.tables[each] = mi.Texture1f(x, use_accel=False, wrap_mode=dr.WrapMode.Clamp)

    def warn_of_clipped(self, values: np.ndarray) -> None:
        """Warn of the rows of reflectance that no medium has, which are clipped."""
        above = (values > self.most * (1 + 1e-6)).any(axis=1)
        if above.any():
            warnings.warn(
                f"{int(above.sum())} of {len(above)} texels of reflectance are above {_short(self.most)}, the "
                "reflectance without absorption, and are clipped",
                stacklevel=2,
            )

    def __call__(self, reflectance: mi.Spectrum) -> mi.Spectrum:
        albedos = []
        for g, most, R in zip(self.g, self.most, reflectance):
            u = (dr.sqrt(dr.clip(R * opaque(1 / most), 0, 1)) * (NODES - 1) + 0.5) / NODES
            x, c = self.tables[g].eval(mi.Point1f(u))[0], opaque(bend(g))
            s2 = dr.square(x / (c + (1 - c) * x))
            albedos.append((1 - s2) / (1 - opaque(g) * s2))
        return mi.Spectrum(albedos)


def _short(values: np.ndarray) -> str:
    return " ".join(dict.fromkeys(f"{v:.4g}" for v in values))


def bend(g: float) -> float:
    """c of `physics.reflectance` for a mean cosine."""
    return (1 - max(g, 0.0)) ** (1 / 3)


def x_of_albedo(lib: ModuleType, albedo: Number, g: Number, c: Number) -> Number:
    """x of `physics.reflectance`: 0 for albedo 1, 1 for albedo 0.
    `lib`: NumPy or Dr.Jit. `albedo`: of single scattering. `g`: mean cosine. `c`: from `bend`."""
    s = lib.sqrt((1 - albedo) / (1 - g * albedo))
    return s * c / (1 - (1 - c) * s)


@dataclass(frozen=True, eq=False)
class TexturedMedium:
    """Albedo and extinction at points of the surface.

    Args:
        albedo: a texture, of reflectance if there is a `table`, or one number per channel.
        sigma_t: a texture, of the mean free path if `inverse`, or one number per channel; 1/mm and mm.
        scale: factor of sigma_t.
        table: albedo by reflectance.
        inverse: whether `sigma_t` is a mean free path.
        variables: of these names, by whose numbers light may be differentiated: those that no texture varies, and
            others in place of texels, which then all change alike.
    """

    albedo: mi.Texture | np.ndarray
    sigma_t: mi.Texture | np.ndarray
    scale: float = 1.0
    table: AlbedoTable | None = None
    inverse: bool = False
    variables: Mapping[str, mi.Spectrum] = field(default_factory=dict)

    def scaled(self, factor: float) -> TexturedMedium:
        """The same in other units of length: sigma_t times a factor."""
        return replace(self, scale=self.scale * factor)

    def at(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> MediumAt:
        """Albedo and sigma_t at a point of the surface."""
        sigma_t = self._extinction(self._value("sigma_t", si, active))
        return MediumAt(self.albedo_at(si, active), sigma_t, mi.UInt32(si.prim_index))

    def at_point(
        self, obj: Geometry, p: mi.Point3f, n: mi.Normal3f, face: mi.UInt32 | None, active: mi.Bool = True
    ) -> MediumAt:
        """The same at a point of an object with its outward normal and its face, if that is known."""
        return self.at(_interaction(obj, p, n, face, active), active)

    def followed(self, obj: Geometry, at: SurfacePoint, active: mi.Bool = True) -> MediumAt:
        """The medium at a point that knows it, with derivatives by texels and attributes where they are followed."""
        if not self.is_followed(obj.shape):
            return at.medium
        found = self.at_point(obj, at.p, at.n, at.medium.face, active)
        albedo, sigma_t = (
            dr.replace_grad(getattr(at.medium, key), getattr(found, key)) for key in ("albedo", "sigma_t")
        )
        return MediumAt(albedo, sigma_t, at.medium.face)

    def ends(self, obj: Geometry, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool) -> list[MediumAt]:
        """The media by whose half-spaces light goes from an entry to an exit: those of both ends, as `followed`."""
        return [self.followed(obj, end, active) for end in (exit, at)]

    def is_followed(self, shape: mi.Shape) -> bool:
        """Whether derivatives by texels, by attributes of a shape, or by constants beside them, are followed."""
        values = [value for texture in self.textures.values() for _, value in mi.traverse(texture)]
        values += self.variables.values()
        values += [mi.traverse(shape)[key] for texture in self.textures.values() for _, key in shown(texture)]
        return any(dr.is_diff_v(value) and dr.grad_enabled(value) for value in values)

    def albedo_at(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """The albedo of single scattering at a point of the surface."""
        value = self._value("albedo", si, active)
        return value if self.table is None else self.table(value)

    def _value(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        source = getattr(self, name)
        followed = self.variables.get(name)
        if not isinstance(source, mi.Texture):
            value = mi.Spectrum([opaque(v) for v in source])
            return value if followed is None else dr.replace_grad(value, followed)
        value = mi.Spectrum(source.eval(si, active))
        return value if followed is None else dr.detach(value) + followed - dr.detach(followed)

    def _extinction(self, value: mi.Spectrum) -> mi.Spectrum:
        scale = opaque(self.scale)
        return scale / value if self.inverse else value * scale

    @property
    def textures(self) -> dict[str, mi.Texture]:
        """The textures by the name of their parameter."""
        names = ("reflectance" if self.table else "albedo", "mfp" if self.inverse else "sigma_t")
        return {name: value for name, value in zip(names, (self.albedo, self.sigma_t)) if isinstance(value, mi.Texture)}

    @property
    def constants(self) -> tuple[str, ...]:
        """The coefficients that no texture varies; g only where no table of albedos is made for it."""
        found = [name for name in ("albedo", "sigma_t") if not isinstance(getattr(self, name), mi.Texture)]
        return (*found, *(("g",) if self.table is None else ()))

    def values_on(self, shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and sigma_t of texels and attributes, shapes (n, channels); of a texture of another kind none."""
        values = {name: _values_on(name, texture, shape) for name, texture in self.textures.items()}
        albedo = values.get("albedo", np.atleast_2d(self.albedo)) if self.table is None else values["reflectance"].T
        if self.table is not None:
            albedo = np.array(self.table(mi.Spectrum(albedo.astype(np.float32)))).reshape(albedo.shape).T
        sigma_t = 1 / values["mfp"] if self.inverse else values.get("sigma_t", np.atleast_2d(self.sigma_t))
        return albedo.astype(float), self.scale * sigma_t.astype(float)

    def mean(self, g: np.ndarray | float, eta: float, shape: mi.Shape | None = None) -> Medium:
        """The homogeneous medium with the means of albedo and extinction over texels, and over vertices of a mesh.
        `g`, `eta`: mean cosine and relative index. `shape`: whose attributes textures may show; without it `UNKNOWN`
        stands for them."""
        means = {name: _mean(name, texture, shape) for name, texture in self.textures.items()}
        albedo = means.get("albedo", self.albedo)
        if self.table is not None:
            R = np.minimum(means["reflectance"], self.table.most)
            albedo = Medium.from_reflectance(R, 1.0, g, eta).albedo
        sigma_t = self.scale * (1 / means["mfp"] if self.inverse else means.get("sigma_t", self.sigma_t))
        pair = (np.minimum(albedo, 1.0).astype(float), sigma_t)
        return Medium.from_albedo(*(v if len(v) > 1 else float(v[0]) for v in pair), g, eta)

    def is_even(self, shape: mi.Shape) -> bool:
        """Whether its textures are the same everywhere on a shape, and no derivatives by them are followed.
        Models are then those of the medium itself, which differ by 0.3 % between nodes of the albedo."""
        values = [_values_on(name, texture, shape) for name, texture in self.textures.items()]
        even = all(len(v) > 0 and (v == v[0]).all() for v in values)
        nodes = [node for texture in self.textures.values() for node in mi.traverse(texture).hierarchy]
        known = all(kind_of(node) in KNOWN for node in nodes)
        with dr.resume_grad():
            return even and known and not self.is_followed(shape)

    def check(self, obj: Geometry | None = None) -> None:
        """Refuse textures that are no medium's, and warn of colours that no medium has, which are clipped.
        `obj`: the object they are on, whose uv and attributes they need; without it their texels are looked at.
        ValueError if texels are not finite, of albedo or reflectance outside [0, 1], of sigma_t or mfp not > 0; or the
        mesh of the object has no uv, or not the attribute."""
        for name, texture in self.textures.items():
            values, hint = texels(texture), ""
            if obj is not None:
                by_uv = any(kind_of(node) in BY_UV for node in mi.traverse(texture).hierarchy)
                if by_uv and obj.shape.is_mesh() and not obj.shape.has_vertex_texcoords():
                    raise ValueError(f"object {obj.name} must have uv for the texture {name}, got a mesh without")
                values = attributes(name, texture, obj.shape)
                hint = (
                    f" in an attribute of {obj.name}; bytes in a mesh file are read as 0 to 255: write floats, linear"
                )
            if len(values):
                check_values(name, values, hint)
            if self.table is not None and name == "reflectance":
                self.table.warn_of_clipped(values)
                if obj is None:
                    _warn_of_raw_bytes(texture)


def _interaction(
    obj: Geometry, p: mi.Point3f, n: mi.Normal3f, face: mi.UInt32 | None, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """The interaction by which textures are looked up at a point: from the face of a mesh, else by a short ray."""
    if obj.transform is not None:
        p, n, obj = obj.transform.point_to_object(p), obj.transform.normal_to_object(n), replace(obj, transform=None)
    if face is None or not obj.shape.is_mesh():
        ray, off = obj.ray_onto(p, n)
        if obj.shape.class_name() == "Sphere":  # which knows its uv without a search
            met = dr.zeros(mi.PreliminaryIntersection3f, dr.width(p))
            met.t, met.shape = off, mi.ShapePtr(obj.shape)
            si = obj.shape.compute_surface_interaction(ray, met, mi.RayFlags.Minimal | mi.RayFlags.UV, active)
            si.shape = mi.ShapePtr(obj.shape)
            return si
        return obj.ray_intersect(ray, mi.RayFlags.Minimal | mi.RayFlags.UV, False, active)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.p, si.n, si.prim_index, si.shape = mi.Point3f(p), mi.Normal3f(n), mi.UInt32(face), mi.ShapePtr(obj.shape)
    if obj.shape.has_vertex_texcoords():
        vertices = mesh.vertices_of(obj.shape, si.prim_index, active)
        a, b, c = mesh.positions_at(obj.shape, vertices, active)
        u, v, w = mesh.texcoords_at(obj.shape, vertices, active)
        e, f, d = b - a, c - a, si.p - a
        ee, ef, ff = dr.dot(e, e), dr.dot(e, f), dr.dot(f, f)
        det = ee * ff - ef * ef
        det = dr.select(det > 0, det, 1)  # a face without area has its first corner
        s = (ff * dr.dot(d, e) - ef * dr.dot(d, f)) / det
        t = (ee * dr.dot(d, f) - ef * dr.dot(d, e)) / det
        si.uv = u + (v - u) * s + (w - u) * t
    return si


def texels(texture: mi.Texture) -> np.ndarray:
    """The values of a texture that are its own, shape (n, channels of the variant); none of attributes of a mesh."""
    values = []
    for node in mi.traverse(texture).hierarchy:
        parameters = mi.traverse(node)
        if kind_of(node) == "BitmapTexture":
            data = _shown_by(node)
            values.append(data.reshape(-1, data.shape[-1]))
        elif "value" in parameters:  # of a constant
            values.append(np.array(parameters["value"], dtype=float).reshape(1, -1))
    return np.concatenate([np.zeros((0, len(mi.Spectrum(0)))), *map(_in_channels, values)])


def _in_channels(values: np.ndarray) -> np.ndarray:
    """Values of one channel or three as textures show them, shape (n, channels of the variant)."""
    n = len(mi.Spectrum(0))
    values = values @ LUMINANCE if values.shape[1] == 3 and n == 1 else values
    return np.broadcast_to(values, (len(values), n))


def _warn_of_raw_bytes(texture: mi.Texture) -> None:
    """Warn of colours in bytes that are read as linear values; such files hold sRGB."""
    bitmaps = [node for node in mi.traverse(texture).hierarchy if kind_of(node) == "BitmapTexture"]
    if any(_is_raw(each) and np.array(mi.traverse(each)["data"]).dtype == np.uint8 for each in bitmaps):
        warnings.warn(
            "reflectance is a bitmap of 8 bits that is read raw, as linear values: colours of such files are sRGB, "
            "which raw = false decodes",
            stacklevel=2,
        )


def _is_raw(bitmap: mi.Texture) -> bool:
    return re.search(r"^  raw = (\d)", str(bitmap), re.MULTILINE).group(1) == "1"


def _shown_by(bitmap: mi.Texture) -> np.ndarray:
    """The values that a bitmap shows, shape (rows, columns, channels); Mitsuba keeps bytes as they are in files."""
    data = np.array(mi.traverse(bitmap)["data"])
    if data.dtype != np.uint8:
        return data.astype(float)
    return data / 255 if _is_raw(bitmap) else linear_of_srgb(data / 255)


def linear_of_srgb(values: np.ndarray) -> np.ndarray:
    """Linear values of sRGB ones (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)


def attributes(name: str, texture: mi.Texture, shape: mi.Shape) -> np.ndarray:
    """The values of attributes of a mesh that a texture shows, shape (n, channels of the variant).
    ValueError if the shape has no such attribute, or one of another number of channels; `name` is the parameter's."""
    values = []
    for node, key in shown(texture):
        if not (shape.is_mesh() and shape.has_attribute(key)):
            raise ValueError(f"object {name_of(shape)} must have the attribute {key!r} of the texture {name}")
        count = shape.face_count() if key.startswith("face_") else shape.vertex_count()
        each = np.array(mi.traverse(shape)[key], dtype=float).reshape(count, -1)
        if each.shape[1] not in (1, 3):
            raise ValueError(
                f"the attribute {key!r} of the texture {name} must have 1 or 3 values, got {each.shape[1]}"
            )
        values.append(_in_channels(each * float(mi.traverse(node)["scale"])))
    return np.concatenate([np.zeros((0, len(mi.Spectrum(0)))), *values])


def shown(texture: mi.Texture) -> list[tuple[mi.Object, str]]:
    """The attributes of a mesh that a texture shows: the node that does, and the name of each."""
    nodes = [node for node in mi.traverse(texture).hierarchy if kind_of(node) == "MeshAttribute"]
    return [(node, re.search(r'name = "([^"]*)"', str(node)).group(1)) for node in nodes]


def kind_of(node: mi.Object) -> str:
    """The class of a texture, without what Mitsuba appends to it."""
    return node.class_name().partition("Impl")[0]


def _values_on(name: str, texture: mi.Texture, shape: mi.Shape) -> np.ndarray:
    """Texels, and attributes of a shape, that a texture shows, shape (n, channels of the variant)."""
    return np.concatenate([texels(texture), attributes(name, texture, shape)])


def _mean(name: str, texture: mi.Texture, shape: mi.Shape | None) -> np.ndarray:
    values = texels(texture) if shape is None else _values_on(name, texture, shape)
    if len(values) and (values == values[0]).all():
        return values[0]  # to the last bit
    return values.mean(axis=0) if len(values) else np.full(len(mi.Spectrum(0)), UNKNOWN[name])


def check_values(name: str, values: np.ndarray, hint: str = "") -> None:
    """ValueError if values of a parameter are no medium's; it ends with the hint."""
    bounds = {
        "albedo": ("in [0, 1]", (values >= 0) & (values <= 1)),
        "reflectance": ("in [0, 1]", (values >= 0) & (values <= 1)),
        "scale": ("finite and > 0", np.isfinite(values) & (values > 0)),
        "sigma_t": ("finite and > 0 (1/mm)", np.isfinite(values) & (values > 0)),
        "mfp": ("finite and > 0 (mm)", np.isfinite(values) & (values > 0)),
    }
    bound, ok = bounds[name]
    if not ok.all():
        raise ValueError(f"{name} must be {bound}, got {float(values[~ok].flat[0])!r}{hint}")


def textured_medium(values: dict[str, Any], g: np.ndarray | float, eta: float, channels: int) -> TexturedMedium:
    """The medium of parameters with at least one texture.
    `values`: `albedo` and `sigma_t`, with or without `scale`, or `reflectance` and `mfp`; textures, or numbers. `g`: a
    number or one per channel. `eta`: relative index. `channels`: of the variant. ValueError if a number is out of
    range, or as `TexturedMedium.check`."""
    if not isinstance(values.get("mfp", 1.0), mi.Texture):
        values = {name: diffuse_limit(value) if name == "mfp" else value for name, value in values.items()}
    for name, value in values.items():
        if not isinstance(value, mi.Texture):
            check_values(name, np.atleast_1d(np.asarray(value, dtype=float)))
            if np.size(value) not in (1, channels):
                raise ValueError(f"{name} must be a number or one per channel ({channels}), got {np.size(value)}")
    painted = "reflectance" in values
    color, extent = (values[key] for key in (("reflectance", "mfp") if painted else ("albedo", "sigma_t")))
    table, inverse = None, painted and isinstance(extent, mi.Texture)
    if painted and isinstance(color, mi.Texture):
        table = AlbedoTable(np.broadcast_to(np.asarray(g, dtype=float), channels).tolist(), eta)
    elif painted:
        color = Medium.from_reflectance(np.broadcast_to(color, channels), 1.0, g, eta).albedo
    if painted and not inverse:
        extent = 1 / np.asarray(extent, dtype=float)
    scale = float(values.get("scale", 1.0))
    if not isinstance(extent, mi.Texture):
        extent, scale = np.asarray(extent, dtype=float) * scale, 1.0
    pair = (v if isinstance(v, mi.Texture) else np.broadcast_to(np.asarray(v, dtype=float), channels).copy()
            for v in (color, extent))  # fmt: skip
    result = TexturedMedium(*pair, scale, table, inverse)
    result.check()
    return result


def constant_texture(value: Any) -> Any:
    """A parameter as it is, but a texture without places by its value."""
    if not isinstance(value, mi.Texture) or value.is_spatially_varying() or kind_of(value) == "MeshAttribute":
        return value
    result = np.ravel(np.array(value.eval(dr.zeros(mi.SurfaceInteraction3f, 1)), dtype=float))
    return result[0] if np.ptp(result) == 0 else result
