"""The identity of a scene: what it holds, whatever Mitsuba calls its objects, wherever they lie and in any order."""

from __future__ import annotations

import hashlib
import re
import sys

import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.snapshot import plain

# a name says nothing of the image but that of an attribute, an address nothing of the scene, and how many samples are
# taken is told elsewhere
_MADE_UP = re.compile(r"0x[0-9a-fA-F]+|\bobject_\d+|\b_unnamed_\d+|__Root\w*")
_LEFT_OUT = re.compile(
    r'^\s*(name = "(?!vertex_|face_).*"|(sample_count|samples_per_wavefront|wavefront_size) = \d+),?$', re.MULTILINE
)


def scene_hash(scene: mi.Scene, integrator: mi.Integrator) -> str:
    """SHA-256 of the objects of a scene, in words and by all their parameters, and of the integrator that renders it.

    The integrator of the scene itself, ids, the order of objects and the number of samples of a sampler are left out.
    What models have learnt is told by `scenes.reference.learnt`.
    """
    own = scene.integrator()
    result = sorted(object_digest(child) for child in children(scene) if child is not own)
    return hashlib.sha256("\n".join([*result, words(integrator)]).encode()).hexdigest()


def children(holder: mi.Object) -> list[mi.Object]:
    """The objects that stand in a scene or in another object, in any order."""

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            mi.TraversalCallback.__init__(self)
            self.found: list[mi.Object] = []

        def put(self, name: str, value: object, flags: object, cpptype: object = None) -> None:
            if isinstance(value, mi.Object):
                self.found.append(value)

    callback = Children()
    holder.traverse(callback)
    return callback.found


def object_digest(node: mi.Object) -> str:
    """SHA-256 of an object of Mitsuba, in words and by all its parameters."""
    flipped = isinstance(node, mi.Shape) and mesh.is_flipped(node)  # of which Mitsuba tells nothing in words
    digest = hashlib.sha256(f"{words(node)}{flipped}".encode())
    for key, content in sorted((_MADE_UP.sub("", key), _content(value)) for key, value in mi.traverse(node).items()):
        digest.update(b"\0%s\0%d\0" % (key.encode(), len(content)))
        digest.update(content)
    return digest.hexdigest()


def words(result: object) -> str:
    """The text of an object by `str`, with all digits where Python prints it."""
    with np.printoptions(precision=17, threshold=sys.maxsize):
        return _LEFT_OUT.sub("", _MADE_UP.sub("", str(result)))


def _content(value: object) -> bytes:
    numbers = np.array(plain(value))
    return str(value).encode() if numbers.dtype == object else str(numbers.shape).encode() + numbers.tobytes()
