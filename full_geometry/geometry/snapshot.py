"""Snapshots of objects of Mitsuba, which show a later edit, and digests, which identify a scene.

Values count, by checksums of their bytes. The numbers that Dr.Jit gives to its variables tell nothing: they are given
again once a variable is freed. Neither would values that are kept: NumPy's views of them write into them.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.rounding import box_ends


class Snapshot:
    """Objects of Mitsuba, which are kept, and checksums of their parameters; equal to another where nothing differs."""

    def __init__(
        self, root: mi.Object, wanted: Callable[[str], bool] | None = None, without: tuple[type, ...] = ()
    ) -> None:
        """Take the snapshot of an object and all that it holds.
        `wanted`: whether a parameter of this name counts; by default all do. `without`: classes of objects that do not
        count."""
        parameters = mi.traverse(root)
        self._nodes = [node for node in parameters.hierarchy if not isinstance(node, without)]
        self._checksums = {
            key: _checksum(value)
            for key, value in parameters.items()
            if not isinstance(parameters.properties[key][2], without) and (wanted is None or wanted(key))
        }

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Snapshot):
            return NotImplemented
        return same_objects(self._nodes, other._nodes) and self._checksums == other._checksums


def differing(a: mi.Object, b: mi.Object) -> list[str] | None:
    """Names of parameters that differ between objects of the same structure; None where that differs."""
    one, other = mi.traverse(a), mi.traverse(b)
    kinds = [{key: owner[2].class_name() for key, owner in each.properties.items()} for each in (one, other)]
    if kinds[0] != kinds[1] or list(one.keys()) != list(other.keys()):
        return None
    return [key for key in one.keys() if _checksum(one[key]) != _checksum(other[key])]


def same_objects(a: list[mi.Object], b: list[mi.Object]) -> bool:
    """Whether two lists hold the same objects of Mitsuba."""
    return len(a) == len(b) and all(x is y for x, y in zip(a, b))


def plain(value: object) -> Any:
    """A parameter without gradients, of a transformation its matrix."""
    if value is None:
        return value
    value = dr.detach(value)
    return value if dr.is_array_v(value) else getattr(value, "matrix", value)  # arrays take any name for components


def _checksum(value: object) -> bytes:
    result = hashlib.sha256()
    for numbers in _numbers(plain(value)):
        result.update(f"{numbers.dtype}{numbers.shape}".encode())
        result.update(np.ascontiguousarray(numbers))
    return result.digest()


def _numbers(value: dr.AnyArray | object) -> Iterator[np.ndarray]:
    """The numbers of a parameter, array by array: to join arrays Dr.Jit would run a kernel."""
    if dr.is_tensor_v(value):
        yield np.array(value.shape)
        yield value.array.numpy()
    elif dr.depth_v(value) > 1:
        for part in value:
            yield from _numbers(part)
    else:
        numbers = value.numpy() if dr.is_jit_v(value) else np.array(value)
        yield np.frombuffer(repr(value).encode(), np.uint8) if numbers.dtype == object else numbers


# --------------------------------------------------------------------------------------------------
# The identity of a scene: what it holds, whatever Mitsuba calls its objects, wherever they lie and in any order.


# a name says nothing of the image but that of an attribute, an address nothing of the scene, how many samples are taken
# is told elsewhere, and the area of a mesh is told once something has asked for it
_MADE_UP = re.compile(r"0x[0-9a-fA-F]+|\bobject_\d+|\b_unnamed_\d+|__Root\w*")
_LEFT_OUT = re.compile(
    r'^\s*(name = "(?!vertex_|face_).*"|(sample_count|samples_per_wavefront|wavefront_size) = \d+),?$'
    r"|^ *surface_area = .*\n",
    re.MULTILINE,
)


def scene_hash(scene: mi.Scene, integrator: mi.Integrator) -> str:
    """SHA-256 of the objects of a scene, in words and by all their parameters, and of the integrator that renders it.
    The integrator of the scene itself, ids, the order of objects and the number of samples of a sampler are left out.
    For the weights of models see `scenes.reference.learnt`."""
    own = scene.integrator()
    result = sorted(object_digest(child) for child in children(scene) if child is not own)
    return hashlib.sha256("\n".join([*result, integrator_words(integrator)]).encode()).hexdigest()


def held(holder: mi.Object) -> list[tuple[str, object]]:
    """Names and values of the objects and parameters that an object of Mitsuba holds."""
    found = []

    class Listing(mi.TraversalCallback):
        def put(self, name: str, value: object, *flags: object) -> None:
            found.append((name, value))

    holder.traverse(Listing())
    return found


def children(holder: mi.Object) -> list[mi.Object]:
    """The objects that stand in a scene or in another object, in any order."""
    return [value for _, value in held(holder) if isinstance(value, mi.Object)]


def object_digest(node: mi.Object) -> str:
    """SHA-256 of an object of Mitsuba, in words and by all its parameters."""
    flipped = isinstance(node, mi.Shape) and mesh.is_flipped(node)  # of which Mitsuba tells nothing in words
    digest = hashlib.sha256(f"{words(node)}{flipped}".encode())
    parameters = mi.traverse(node)
    for name, key in sorted((_MADE_UP.sub("", key), key) for key in parameters.keys()):
        content = _content(parameters[key])
        if key.endswith("data"):
            content += filtering(parameters.properties[key][2]).encode()
        digest.update(b"\0%s\0%d\0" % (name.encode(), len(content)))
        digest.update(content)
    for part in parameters.hierarchy:
        for volume in getattr(part, "volumes", ()):  # of `translucent`
            digest.update(object_digest(volume).encode())
    return digest.hexdigest()


# Mitsuba says nowhere how texels are filtered and go on beyond the edges of a bitmap; values at places tell it, in
# words, for the last bits of values differ between processors.
PLACES = 2**12
STEP, JUMP, SAME = 1 / 8, 0.4, 1e-2  # texels; shares of the largest difference


def filtering(node: mi.Object) -> str:
    """How a bitmap or a grid shows its values, where that differs from Mitsuba's defaults and can be seen, else ''."""
    kind, x = node.class_name().partition("Impl")[0], np.random.default_rng(5).random((3, PLACES))
    if kind == "BitmapTexture":
        x, show = 3 * x[:2] - 1, _bitmap_at(node)
    elif kind == "GridVolume":
        show = _grid_in(node, *box_ends(node.bbox())[..., None])
    else:
        return ""
    size = np.array(node.resolution(), dtype=float).ravel()
    value, result = show(x), []

    # values that jump within a small part of a texel are those of the nearest one
    far, near = (np.abs(show(x + step / size[:, None]) - value).max() for step in (1, STEP))
    if near > JUMP * far:
        result.append("nearest")
    if kind == "BitmapTexture":
        ways = {"repeat": x % 1, "clamp": x.clip(0, 1), "mirror": 1 - np.abs(x % 2 - 1)}
        apart = {way: np.abs(show(y) - value).mean() for way, y in ways.items()}
        if apart["repeat"] > SAME * np.ptp(value):
            result.append(min(apart, key=apart.get))
    return " ".join(result)


def _bitmap_at(bitmap: mi.Texture) -> Callable[[np.ndarray], np.ndarray]:
    """Its values by places (2, n) among the texels, 0 to 1 within the edges."""
    inverse = np.linalg.pinv(np.array(plain(mi.traverse(bitmap)["to_uv"]), dtype=float).reshape(3, 3))

    def show(x: np.ndarray) -> np.ndarray:
        si = _interaction(mi.SurfaceInteraction3f, "uv", inverse[:2, :2] @ x + inverse[:2, 2:])
        if mi.is_spectral:
            si.wavelengths += 550.0
        try:
            return _numbers_of(bitmap.eval_1(si))
        except RuntimeError:  # colours that have become spectra
            return _numbers_of(bitmap.eval(si)[0])

    return show


def _grid_in(grid: mi.Volume, low: np.ndarray, high: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Its values by places (3, n) in a box, 0 to 1."""
    return lambda x: _numbers_of(grid.eval_n(_interaction(mi.Interaction3f, "p", low + x * (high - low)))[0])


def _interaction(kind: type, name: str, x: np.ndarray) -> mi.Interaction3f:
    result = dr.zeros(kind, x.shape[1])
    setattr(result, name, (mi.Point2f, mi.Point3f)[len(x) - 2](*x.astype(np.float32)))
    return result


def _numbers_of(values: mi.Float) -> np.ndarray:
    return np.array(dr.detach(values), dtype=float) + np.zeros(PLACES)


def words(result: object) -> str:
    """The text of an object by `str`, with all digits where Python prints it."""
    with np.printoptions(precision=17, threshold=sys.maxsize):
        return _LEFT_OUT.sub("", _MADE_UP.sub("", str(result)))


def integrator_words(integrator: mi.Integrator) -> str:
    """The text of an integrator, with the emitters that it or those inside it hide, which Mitsuba's leave out."""
    hidden = [
        words(each) for each in (integrator, *children(integrator))
        if getattr(each, "hide_emitters", False) and "hide_emitters" not in words(each)
    ]  # fmt: skip
    return "\n".join([words(integrator), *(f"hide_emitters: {each}" for each in hidden)])


def _content(value: object) -> bytes:
    numbers = np.array(plain(value))
    return str(value).encode() if numbers.dtype == object else str(numbers.shape).encode() + numbers.tobytes()
