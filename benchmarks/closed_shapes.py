"""Closed shapes of one size, drawn by a seed: ball, blob, slab, ring and spikes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halfspace_sss.provenance import write_atomically

SHAPES = ("ball", "blob", "slab", "ring", "spikes")
SIZE = 100.0  # mm across
COLUMNS, ROWS = 96, 48  # of the mesh


def write_shape(path: Path, shape: str, seed: tuple[int, ...]) -> None:
    """Write a shape of `SHAPES` as a PLY file."""
    write_atomically(path, _ply(*_mesh(shape, np.random.default_rng(seed))))


def _mesh(shape: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, mm, and outward faces of a closed surface, SIZE across."""
    v, faces = _torus() if shape == "ring" else _globe()
    if shape == "blob":
        v = v * (1 + _waves(v, rng, 3.0, 0.35))[:, None]
    if shape == "spikes":
        v = v * np.exp(_waves(v, rng, 6.0, 0.6))[:, None]
    if shape == "slab":
        v = np.sign(v) * np.abs(v) ** 0.35 * np.array([1.0, 0.7, rng.uniform(0.06, 0.2)])
    size = np.linalg.norm(np.ptp(v, axis=0))
    return SIZE / size * (v - 0.5 * (v.min(0) + v.max(0))), faces


def _waves(v: np.ndarray, rng: np.random.Generator, frequency: float, height: float) -> np.ndarray:
    """A smooth random function of directions, at most `height`."""
    k, phase = rng.standard_normal((8, 3)) * frequency / 1.7, rng.uniform(0, 2 * np.pi, 8)
    return height * np.cos(v @ k.T + phase).mean(axis=1) * 1.5


def _globe() -> tuple[np.ndarray, np.ndarray]:
    theta = np.linspace(0, np.pi, ROWS + 1)[1:-1]
    phi = np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    x = np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)
    rings = np.stack([*x, np.broadcast_to(np.cos(theta)[:, None], x[0].shape)], axis=-1).reshape(-1, 3)
    v = np.concatenate([rings, [[0, 0, 1], [0, 0, -1]]])
    north, south, n = len(v) - 2, len(v) - 1, len(theta)
    j = np.arange(COLUMNS)
    right = (j + 1) % COLUMNS
    top = np.stack([np.full(COLUMNS, north), j, right], axis=1)
    low = (n - 1) * COLUMNS
    bottom = np.stack([np.full(COLUMNS, south), low + right, low + j], axis=1)
    return v, np.concatenate([top, _quads(n - 1, COLUMNS, wrap=False), bottom])


def _torus() -> tuple[np.ndarray, np.ndarray]:
    a, b = np.arange(ROWS) / ROWS * 2 * np.pi, np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    rho = 1 + 0.3 * np.cos(a)[:, None]
    v = np.stack([rho * np.cos(b), rho * np.sin(b), np.broadcast_to(-0.3 * np.sin(a)[:, None], (ROWS, COLUMNS))], -1)
    return v.reshape(-1, 3), _quads(ROWS, COLUMNS, wrap=True)


def _quads(rows: int, columns: int, wrap: bool) -> np.ndarray:
    """Two triangles for each cell of a grid whose columns close."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    below = (i + 1) % rows if wrap else i + 1
    right = (j + 1) % columns
    a, b, c, d = i * columns + j, below * columns + j, below * columns + right, i * columns + right
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _ply(v: np.ndarray, faces: np.ndarray) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(v)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.zeros(len(faces), dtype=[("n", "u1"), ("index", "<i4", 3)])
    rows["n"], rows["index"] = 3, faces
    return head.encode() + v.astype("<f4").tobytes() + rows.tobytes()
