"""The meshes of the scenes in docs/scenes, in mm: `python -m benchmarks.gallery_meshes` writes them there again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.head_and_leaf import make_head

FOLDER = Path(__file__).parent.parent / "docs" / "scenes"
AROUND = 48  # corners around the axis of what is turned on a lathe
HEAD = 48  # cubes along the height of the head


def arc(centre: tuple[float, float], radius: float, start: float, end: float, n: int = 7) -> list[tuple[float, float]]:
    """Points of a circle in the plane of radius and height, from one angle to another in degrees."""
    angles = np.radians(np.linspace(start, end, n))
    return list(zip(centre[0] + radius * np.cos(angles), centre[1] + radius * np.sin(angles)))


PROFILES = {  # radius and height from the axis below to the axis above, which is +y
    "candle": [(0, 0), *arc((14, 1), 1, -90, 0), (15, 12), (15, 24), *arc((13.5, 34), 1.5, 0, 120), (8, 31), (0, 30)],
    "glass": [(0, 0), *arc((17, 2), 2, -90, 0), (20, 18), (22, 46), *arc((21.2, 46), 0.8, 0, 180), (18.2, 18),
              *arc((16, 6), 2, 0, -90), (0, 4)],
    "drink": [(0, 3), *arc((16.6, 5), 2, -90, 0), (19.1, 18), (20.5, 34), (0, 34)],
    "toy": [(0, 1.5), *arc((0, 13), 14, -55, 55, 18), *arc((0, 33), 9.5, -50, 90, 14)],
    "rind": [*arc((0, 0), 25, -90, -2, 20), *arc((23.5, -0.3), 1.5, 0, 180, 5), *arc((0, 0), 22, -2, -90, 20)],
    "flesh": [*arc((0, 0), 21.9, -90, -3, 20), *arc((20.8, -1.1), 1, 0, 90, 4), (10, 0), (0, 0)],
}  # fmt: skip


def turned(profile: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, uv and faces of a profile around +y; u goes around, v along, and the seam has its corners twice."""
    r, y = np.array(profile, dtype=float).T
    v, u = np.meshgrid(np.linspace(0, 1, len(r)), np.linspace(0, 1, AROUND + 1), indexing="ij")
    angle = 2 * np.pi * u
    x, z = np.cos(angle) * np.maximum(r, 0)[:, None], -np.sin(angle) * np.maximum(r, 0)[:, None]
    return _grid(np.stack([x, np.broadcast_to(y[:, None], x.shape), z], axis=-1), np.stack([u, v], axis=-1))


def _grid(p: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, uv and faces of points (rows, columns, 3), without faces that have no area."""
    rows, columns = p.shape[:2]
    i, j = (k.ravel() for k in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a, b, c, d = (columns * (i + k) + j + m for k, m in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    p = p.reshape(-1, 3)
    n = np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]])
    return p, uv.reshape(-1, 2), faces[np.linalg.norm(n, axis=1) > 1e-9]


def block(n: int = 48, power: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rounded cube from -1 to 1: a superellipsoid."""
    v, u = np.meshgrid(np.linspace(-0.5, 0.5, n // 2 + 1), np.linspace(0, 2, n + 1), indexing="ij")

    def curve(x: np.ndarray) -> np.ndarray:
        x = np.where(np.abs(x) < 1e-12, 0, x)
        return np.sign(x) * np.abs(x) ** power

    cos_v = curve(np.cos(np.pi * v))
    p = np.stack(
        [cos_v * curve(np.cos(np.pi * u)), curve(np.sin(np.pi * v)), -cos_v * curve(np.sin(np.pi * u))], axis=-1
    )
    return _grid(p, np.stack([u / 2, v + 0.5], axis=-1))


def leaf(n: int = 32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An open sheet from -40 to 40 mm, bent along and folded at its rib."""
    s, t = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n // 2 + 1), indexing="ij")
    wide = 18 * np.clip(1 - s * s, 0, 1) ** 0.8 * (1 - 0.25 * s)
    x, z = 40 * s, wide * t
    y = -6 * s * s + 0.35 * np.abs(z) - 0.4 * np.cos(9 * np.pi * s - 4 * np.abs(t)) * np.abs(t)
    return _grid(np.stack([x, y, z], axis=-1), np.stack([(s + 1) / 2, (t + 1) / 2], axis=-1))


def write(path: Path, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> None:
    """A binary PLY file."""
    names = ["x", "y", "z", *(("u", "v") if uv is not None else ())]
    values = vertices if uv is None else np.hstack([vertices, uv])
    lists = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3)])
    lists["n"], lists["v"] = 3, faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(lines).encode() + values.astype("<f4").tobytes() + lists.tobytes())


def write_all(folder: Path) -> None:
    """All of them."""
    head = make_head(HEAD)
    write(folder / "head.ply", 30 * head.vertices, head.faces)
    for name, (vertices, uv, faces) in {
        "block": block(),
        "leaf": leaf(),
        **{k: turned(p) for k, p in PROFILES.items()},
    }.items():
        write(folder / f"{name}.ply", vertices, faces, uv)


if __name__ == "__main__":
    write_all(FOLDER)
