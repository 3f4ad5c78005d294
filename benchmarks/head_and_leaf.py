"""A leaf, and a head that is painted: its surface, texture coordinates around it, and the paint.

Units are about half the width of the head. Texture coordinates are the azimuth about y, 0.5 in front, and the height;
the seam is at the back.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.modelling.meshes import Box, Mesh, capsule, cut, ellipsoid, join, overlap, smoothstep, surface
from benchmarks.random_shapes import Made, margin
from figures.parts.part import SceneDict

BOX = Box((-1.3, -2.1, -1.5), (1.3, 1.6, 1.6))
TEXELS = 512  # around and along the height
SKIN, LIPS, BROWS, WHITE, IRIS, PUPIL = (
    np.array(c)
    for c in (
        (0.72, 0.50, 0.40), (0.62, 0.20, 0.18), (0.12, 0.07, 0.05), (0.85, 0.84, 0.80), (0.16, 0.32, 0.42),
        (0.02, 0.02, 0.02),
    )
)  # fmt: skip
STRIPES = ((0.10, 0.35, 0.55), (0.80, 0.66, 0.16), (0.66, 0.14, 0.12))  # of the paint on cheeks and forehead
EYE = (0.36, 0.16)  # x to the side, and height


def make_head(resolution: int) -> Mesh:
    """The surface; `resolution` cubes along its height, >= 8."""
    return surface(distance, BOX, resolution)


def distance(p: np.ndarray) -> np.ndarray:
    """About the distance to the surface, < 0 inside."""
    p = np.array(p, dtype=float)
    side = np.stack([np.abs(p[..., 0]), p[..., 1], p[..., 2]], axis=-1)

    def ball(q: np.ndarray, at: tuple[float, float, float], radii: tuple[float, float, float]) -> np.ndarray:
        return ellipsoid(q - np.array(at), radii)

    d = join(ball(p, (0, 0.5, -0.12), (0.86, 0.95, 1.08)), ball(p, (0, -0.35, 0.2), (0.62, 0.8, 0.72)), 0.35)
    d = join(d, capsule(p, (0, -0.6, -0.35), (0, -2.3, -0.5), 0.46, 0.62), 0.25)  # neck
    d = join(d, ball(p, (0, -0.88, 0.62), (0.26, 0.2, 0.24)), 0.25)  # chin
    d = join(d, ball(side, (0.42, -0.18, 0.62), (0.26, 0.24, 0.2)), 0.2)  # cheeks
    d = cut(d, ball(side, (*EYE, 1.06), (0.26, 0.17, 0.22)), 0.14)  # sockets
    d = join(d, ball(side, (EYE[0], EYE[1] - 0.01, 0.7), (0.19, 0.17, 0.19)), 0.03)  # eyeballs
    d = join(d, capsule(side, (0.14, 0.37, 0.93), (0.56, 0.38, 0.7), 0.07, 0.06), 0.12)  # brows
    nose = join(
        capsule(p, (0, 0.22, 0.92), (0, -0.24, 1.2), 0.08, 0.13),
        ball(side, (0.13, -0.27, 1.03), (0.1, 0.09, 0.13)),
        0.1,
    )
    d = join(d, nose, 0.12)
    d = cut(d, ball(side, (0.075, -0.35, 1.08), (0.045, 0.06, 0.07)), 0.02)  # nostrils
    lips = join(ball(p, (0, -0.53, 0.92), (0.27, 0.06, 0.12)), ball(p, (0, -0.64, 0.9), (0.23, 0.07, 0.13)))
    d = join(d, lips, 0.05)
    ear = cut(ball(side, (0.9, 0.02, -0.1), (0.1, 0.32, 0.22)), ball(side, (1.0, 0.04, -0.05), (0.06, 0.2, 0.12)), 0.05)
    return overlap(join(d, ear, 0.06), -1.95 - p[..., 1], 0.06)


def texture_coordinates(p: np.ndarray) -> np.ndarray:
    """u and v of points, shape (n, 2): azimuth about y and height in the box."""
    azimuth = np.arctan2(p[:, 0], p[:, 2]) / (2 * np.pi) + 0.5
    return np.stack([azimuth, (p[:, 1] - BOX.low[1]) / (BOX.high[1] - BOX.low[1])], axis=-1)


def paint() -> np.ndarray:
    """Reflectance by texel, shape (rows, columns, 3); rows go up, as v does in files of meshes."""
    u, v = np.meshgrid(*(2 * [(np.arange(TEXELS) + 0.5) / TEXELS]))
    azimuth, y = 2 * np.pi * (u - 0.5), BOX.low[1] + v * (BOX.high[1] - BOX.low[1])
    x = np.abs(azimuth)  # to the side, about the length over the face

    def over(below: np.ndarray, colour: np.ndarray | tuple, distance: np.ndarray, soft: float = 0.015) -> np.ndarray:
        share = smoothstep(soft, -soft, distance)[..., None]
        return (1 - share) * below + share * np.asarray(colour)

    def spot(at: tuple[float, float], radii: tuple[float, float]) -> np.ndarray:
        return (np.hypot((x - at[0]) / radii[0], (y - at[1]) / radii[1]) - 1) * min(radii)

    result = np.broadcast_to(SKIN, (*u.shape, 3))
    result = over(result, (0.74, 0.34, 0.28), spot((0.6, -0.2), (0.28, 0.2)), 0.12)  # cheeks
    for k, colour in enumerate(STRIPES):
        slant = y + 0.3 * x + 0.02 * np.sin(14 * azimuth)
        stripe = np.maximum(np.abs(slant + 0.13 * (k - 1)) - 0.035, np.abs(azimuth - 0.72) - 0.34)
        result = over(result, colour, stripe)
        result = over(result, colour, (np.hypot(azimuth, y - 0.82) - 0.09 * (3 - k)))
    brow = np.maximum(np.abs(y - 0.37 - 0.06 * np.sin(4 * x)) - 0.04, np.abs(x - 0.42) - 0.24)
    result = over(result, BROWS, brow)
    eye = 0.46
    for colour, radii in ((WHITE, (0.13, 0.075)), (IRIS, (0.07, 0.07)), (PUPIL, (0.032, 0.032))):
        result = over(result, colour, spot((eye, EYE[1] - 0.01), radii), 0.008)
    result = over(result, LIPS, spot((0, -0.585), (0.3, 0.1)), 0.02)
    hair = 0.93 + 0.08 * np.sin(9 * azimuth) * np.cos(23 * azimuth) - smoothstep(0.8, 1.5, x) * 0.9
    return over(result, (0.16, 0.09, 0.05), hair - y)


def write_painted(mesh: Mesh, path: Path) -> SceneDict:
    """The head as a shape of `mitsuba.load_dict`, its file written, and the paint as a texture: "shape" and "paint"."""
    import mitsuba as mi

    from full_geometry.geometry.mesh import GEOMETRY, TEXCOORDS

    built = mi.Mesh(
        "head", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, has_vertex_texcoords=True
    )  # fmt: skip
    smooth, parameters = mi.traverse(mesh.mitsuba("smooth")), mi.traverse(built)
    for key in GEOMETRY:
        parameters[key] = smooth[key]
    parameters[TEXCOORDS] = texture_coordinates(mesh.vertices).astype(np.float32).ravel()
    parameters.update()
    built.write_ply(str(path))
    texels = np.ascontiguousarray(paint(), dtype=np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    return {"shape": {"type": "ply", "filename": str(path)}, "paint": texture}


def leaves(rng: np.random.Generator) -> Made:
    """A bent leaf with a rib and a stalk, of a family of shapes that `neural_shape` was not trained on."""
    long, wide, thick = rng.uniform(0.7, 1.0), rng.uniform(0.25, 0.5), rng.uniform(0.025, 0.07)
    bend, fold = rng.uniform(0, 0.5), rng.uniform(0, 0.4)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(p, -1, 0)
        z = z - bend * x * x - fold * np.abs(y)
        edge = np.abs(y) - wide * np.clip(1 - (x / long) ** 2, 0, 1)
        leaf = overlap(np.maximum(edge, np.abs(x) - long) / 2, (np.abs(z) - thick) / (1 + bend + fold), 0.02)
        bent = np.stack([x, y, z], axis=-1)
        rib = capsule(bent, (-1.25 * long, 0, 0), (0.8 * long, 0, 0), 0.07, 0.04)
        return join(leaf, rib / (1 + bend + fold), 0.03)

    high = bend * 1.6 * long**2 + fold * wide + 0.12
    return distance, margin((-1.35 * long, -wide, -0.15), (long + 0.02, wide, high))


LEAVES = {"leaves": leaves}
