"""Frames of an animation: a scene that is edited in place, so that light is found anew only where something changed.

Gathered and corrected light are drawn at fixed points of an object by fixed numbers, and stay while only a camera
moves: frames do not flicker.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from full_geometry.geometry.snapshot import plain
from full_geometry.scenes.reference import loaded
from full_geometry.scenes.scene_files import first_cause, is_pose, like, open_scene, put
from full_geometry.viewing.live import image_of
from halfspace_sss.checks import check_count, did_you_mean

Rows = Sequence[Mapping[str, ArrayLike]] | Mapping[str, Sequence[ArrayLike]]
POSE, VERTICES, NORMALS = ".to_world", ".vertex_positions", ".vertex_normals"


def frames(
    scene: mi.Scene | dict[str, Any] | str | Path,
    rows: str | Path | Rows,
    *,
    sensor: int = 0,
    spp: int = 0,
    seed: int = 0,
) -> Iterator[np.ndarray]:
    """Images (H, W, channels) of a scene, one for each row of edits, by its integrator.

    Args:
        scene: of Mitsuba, which is edited and stays as the last frame has it; or as of `open_scene`.
        rows: of each frame the values by key, as of `Animation`; or of each key the values of all frames; or a file,
            see `read_rows`.
        sensor: number of the sensor.
        spp: samples a pixel; 0 for those of the sampler.
        seed: of all frames: those that show the same are the same.

    Raises:
        ValueError: as `open_scene`, `Animation` and `read_rows`, before the first image; or an image is refused.
    """
    check_count("spp", spp, 0)
    check_count("seed", seed, 0)
    if isinstance(rows, (str, Path)):
        rows = read_rows(rows)
    animation = Animation(scene if isinstance(scene, mi.Scene) else open_scene(scene), rows)
    made, integrator = loaded(animation.scene, None, sensor)
    shown = map(animation.show, range(len(animation)))
    return (image_of(integrator.render, made, made.sensors()[sensor], seed, spp) for _ in shown)


class Animation:
    """A scene and its edits by frame.

    Args:
        scene: of Mitsuba; it is shown as the first frame has it.
        rows: of each frame the values by key, or of each key the values of all frames. Keys are those of
            `mitsuba.traverse`, with values as many as there. A `to_world` takes the matrix, 16 numbers by rows, or the
            9 of origin, target and up; that of a mesh moves it from where it stands in the scene.

    Raises:
        ValueError: there is no such key, a frame lacks a value, columns differ in length, numbers are not finite or too
            many or few, or the scene refuses them.
    """

    def __init__(self, scene: mi.Scene, rows: Rows) -> None:
        self.scene, table = scene, _complete(rows)
        parameters = mi.traverse(scene)
        known = {key: parameters[key] for key in parameters.keys() if _is_number(key, parameters[key])}
        of_meshes = [key for key in known if key.endswith((VERTICES, NORMALS))]
        self._rest = {key: np.array(plain(known[key]), dtype=float) for key in of_meshes}
        meshes = [key.removesuffix(VERTICES) + POSE for key in of_meshes if key.endswith(VERTICES)]
        for key in table[0].keys() - known.keys() - set(meshes):
            near = did_you_mean(key, [*known, *meshes])
            raise ValueError(f"key must be a number or a transformation of the scene by its id, got {key!r}{near}")
        self._meshes = {key for key in meshes if key not in known}
        self._rows = [
            {key: _numbers(f"{key} of frame {k + 1}", value, known.get(key)) for key, value in row.items()}
            for k, row in enumerate(table)
        ]
        self._shown: dict[str, np.ndarray] = {}
        media = {key for key in table[0] if ".bsdf." in key}
        for k in (*range(len(self) if media else 0), 0):  # a medium is refused here, before any image
            self._put(k, media)
        self.show(0)

    def __len__(self) -> int:
        return len(self._rows)

    def show(self, k: int) -> None:
        """Bring the scene to frame k, from 0."""
        self._put(k, set(self._rows[k]))

    def _put(self, k: int, keys: set[str]) -> None:
        """Change what differs from what is shown."""
        row = self._rows[k]
        changed = {key: row[key] for key in row if key in keys and not np.array_equal(row[key], self._shown.get(key))}
        values = {key: value for key, value in changed.items() if key not in self._meshes}
        for key in self._meshes & changed.keys():
            values |= self._moved(key, row[key])
        parameters = mi.traverse(self.scene)
        try:
            put(self.scene, {key: like(parameters[key], value) for key, value in values.items()}, list(values))
        except (RuntimeError, ValueError) as error:
            raise ValueError(f"frame {k + 1}: {first_cause(error)}") from error
        self._shown |= changed

    def _moved(self, key: str, matrix: np.ndarray) -> dict[str, np.ndarray]:
        """Vertices and normals of a mesh: p' = A p + t, and n' = A^-T n."""
        name, A = key.removesuffix(POSE), matrix[:3, :3]
        p = self._rest[name + VERTICES].reshape(-1, 3) @ A.T + matrix[:3, 3]
        n = self._rest.get(name + NORMALS, np.zeros(0)).reshape(-1, 3) @ np.linalg.inv(A)
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
        return {name + VERTICES: p} | ({name + NORMALS: n} if n.size else {})


def read_rows(file: str | Path) -> Rows:
    """Rows of edits from a file: JSON, a list of objects; or CSV, a header of keys, numbers in a cell by spaces.

    Raises:
        ValueError: the file cannot be read, or a row has more cells than the header.
    """
    try:
        text = Path(file).read_text(encoding="utf-8-sig")
        if Path(file).suffix.lower() == ".json":
            return json.loads(text) or []
    except (OSError, ValueError) as error:
        raise ValueError(f"frames must be a JSON or CSV file with rows, got {str(file)!r}: {error}") from error
    rows = list(csv.DictReader(text.splitlines(), restval="", restkey=""))
    for k, row in enumerate(rows):
        if "" in row:
            raise ValueError(f"frame {k + 1} must have as many cells as the header, which has names, got {row['']!r}")
    return [{key: re.findall(r"[^\s,;\[\]]+", cell) for key, cell in row.items()} for row in rows]


def _complete(rows: Rows) -> list[dict[str, ArrayLike]]:
    """Rows of edits, each with a value for each key."""
    if isinstance(rows, Mapping):
        counts = {key: len(column) for key, column in rows.items()}
        if len(set(counts.values())) > 1:
            raise ValueError(f"columns must have a value for each frame, got {counts}")
        rows = [dict(zip(rows, values)) for values in zip(*rows.values())]
    if not (isinstance(rows, Sequence) and rows and all(isinstance(row, Mapping) and row for row in rows)):
        raise ValueError("frames must be rows of values by key, at least one, got none or something else")
    for key in dict.fromkeys(key for row in rows for key in row):
        lacking = next((k + 1 for k, row in enumerate(rows) if row.get(key) is None or np.size(row[key]) == 0), None)
        if lacking:
            raise ValueError(f"{key} must have a value in each frame, got none in frame {lacking}")
    return [dict(row) for row in rows]


def _is_number(key: str, value: object) -> bool:
    """Whether a parameter is real numbers or a transformation, but for the index, which kernels have as it is."""
    return ".boundary." not in key and (isinstance(value, float) or is_pose(value) or dr.is_float_v(value))


def _numbers(name: str, value: ArrayLike, old: object) -> np.ndarray:
    """The numbers of a value in the shape of what stands there; None stands for the pose of a mesh."""
    try:
        found = np.array(plain(value), dtype=float).ravel()
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, got {value!r}") from None
    there = np.eye(4) if old is None else np.array(plain(old))
    shape = there.shape if old is not None and dr.is_tensor_v(old) else there.squeeze().shape
    if shape == (4, 4) and found.size == 9:
        found = np.array(mi.ScalarTransform4f().look_at(*found.reshape(3, 3).tolist()).matrix, dtype=float).ravel()
    size = math.prod(shape)
    if found.size == 1 and 1 < size <= 4:
        found = found.repeat(size)
    if found.size != size:
        asked = "16 numbers, or 9 for origin, target and up" if shape == (4, 4) else f"{size} numbers"
        raise ValueError(f"{name} must be {asked}, got {found.size}")
    found = found.reshape(shape)
    if not np.isfinite(found).all():
        raise ValueError(f"{name} must be finite, with an up that is not the view of a camera, got {value!r}")
    size = np.linalg.det(found[:3, :3]) if shape == (4, 4) else 1.0
    if size == 0 or old is None and size < 0 or shape == (4, 4) and not np.array_equal(found[3], (0, 0, 0, 1)):
        raise ValueError(f"{name} must be an invertible matrix by rows that mirrors no mesh, got {value!r}")
    return found
