"""A mesh whose interpolated normals are far from those of its faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def coarse_ball(folder: Path) -> dict:
    """80 triangles with the vertex normals of the sphere about them."""
    g = (1 + np.sqrt(5)) / 2
    corners = np.array([[s, t * g, 0] for s in (-1, 1) for t in (-1, 1)], dtype=float)
    corners = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    edge = np.linalg.norm(corners[:, None] - corners, axis=2)
    near = (edge > 0) & (edge < 1.1)
    faces = [
        (a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[a, c]
    ]
    lines = []
    for a, b, c in corners[np.array(faces)]:
        ab, bc, ca = (v / np.linalg.norm(v) for v in (a + b, b + c, c + a))
        for x, y, z in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
            turned = np.dot(np.cross(y - x, z - x), x) < 0
            lines += [" ".join(map(str, v)) for v in ((x, z, y) if turned else (x, y, z))]
    numbers = range(1, len(lines) + 1)
    text = [f"{kind} {line}" for kind in ("v", "vn") for line in lines]
    text += [f"f {k}//{k} {k + 1}//{k + 1} {k + 2}//{k + 2}" for k in numbers[::3]]
    (folder / "ball.obj").write_text("\n".join(text))
    return {"type": "obj", "filename": str(folder / "ball.obj")}
