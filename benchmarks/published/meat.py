"""A steak of marbled beef, which Fig. 7 has beside the objects of `benchmarks.modelling`; lengths in mm.

The import of this module adds it to `MODELS` and to the views of Fig. 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.modelling.meshes import Box, cells, fbm, length, noise, overlap, rotated, smoothstep
from benchmarks.modelling.objects import MODELS
from benchmarks.published.fig01 import VIEWS, View

MEAT_BOX = Box((-46.0, -1.5, -35.0), (46.0, 24.0, 35.0))
HALF_LENGTH, HALF_WIDTH, THICKNESS = 41.0, 29.0, 20.0
RIM = 4.5  # thickness of the fat along the side, mm
FIBRE = 0.25  # slant of the fibres against the vertical, radians


@dataclass(frozen=True)
class Meat:
    """The distances and the tissues of a steak of marbled beef with a given seed, with a rim of fat along one side.
    It is about 87 mm long, 64 mm wide and 21 mm thick."""

    seed: int = 0

    def outline(self, p: np.ndarray) -> np.ndarray:
        """Distance from the side, seen from above: an uneven egg with a shallow bay at the rim."""
        x, y, z = np.moveaxis(p, -1, 0)
        x, z = x + 0.12 * y, z - 0.08 * y
        flat = np.stack([x, 0 * y, z], axis=-1)
        wide = HALF_WIDTH * (1 - 0.16 * x / HALF_LENGTH)
        k = (np.abs(x / HALF_LENGTH) ** 2.5 + np.abs(z / wide) ** 2.5 + 1e-9) ** 0.4
        bay = 4.0 * np.exp(-(((x - 9) / 9) ** 2 + ((z + 27) / 8) ** 2))
        return (
            (k - 1) * 0.92 * HALF_WIDTH + 2.2 * noise(flat / 21, self.seed) + 0.5 * noise(flat / 7, self.seed + 1) + bay
        )

    def distance(self, p: np.ndarray) -> np.ndarray:
        """Of the surface: bulging sides, cut faces with the grain in relief, fat a little proud of the flesh."""
        y = p[..., 1]
        bulge = 1.2 * (1 - ((y - THICKNESS / 2) / (THICKNESS / 2)) ** 2)
        flat = np.stack([p[..., 0], 0 * y, p[..., 2]], axis=-1)
        top = THICKNESS + 0.9 * noise(flat / 24, self.seed + 2)
        faces = np.maximum(y - top, -y)
        return overlap(self.outline(p) - bulge, faces, 4.0) - self._relief(p)

    def _relief(self, p: np.ndarray) -> np.ndarray:
        """Height of the surface, mm."""
        fine = 0.1 * noise(self._grain(p) / np.array([1.3, 9.0, 1.3]), self.seed + 3)
        return fine + 0.12 * noise(p / 4, self.seed + 4) + 0.22 * self.fat(p)

    def _grain(self, p: np.ndarray) -> np.ndarray:
        """Points in coordinates whose y runs along the fibres."""
        return rotated(p, 2, FIBRE)

    def fat(self, p: np.ndarray) -> np.ndarray:
        """Share of fat, 0 to 1: the rim, a few seams between muscles, marbling that branches between them."""
        q = self._grain(p) * np.array([1.0, 0.4, 1.0])
        warp = np.stack([fbm(q / 15, self.seed + 10 + i, 2) for i in range(3)], axis=-1)
        fine = np.stack([fbm(q / 5, self.seed + 15 + i, 2) for i in range(3)], axis=-1)
        rich = smoothstep(-0.3, 0.4, noise(q / 17, self.seed + 6))
        seams = self._sheets(q + 4 * warp + 0.5 * fine, 33.0, 1.5, self.seed + 5)
        seams = seams * smoothstep(-0.3, 0.1, noise(q / 12, self.seed + 30))
        veins = self._sheets(q + 3 * warp + 0.8 * fine, 11.5, 0.25 + 0.75 * rich, self.seed + 7)
        veins = veins * smoothstep(-0.2, 0.2, noise(q / 5, self.seed + 8) + 0.4 * rich - 0.15)
        flecks = self._sheets(q + 1.5 * warp + 0.8 * fine, 5.5, 0.1 + 0.35 * rich, self.seed + 9)
        flecks = flecks * smoothstep(0.05, 0.3, noise(q / 3.5, self.seed + 20) + 0.3 * (rich - 0.6))
        return np.maximum.reduce([self._rim(p), seams, veins, 0.9 * flecks])

    def _sheets(self, q: np.ndarray, size: float, thick: float | np.ndarray, seed: int) -> np.ndarray:
        """1 within `thick` mm of the walls between cells of a given size, falling to 0 over 0.5 mm."""
        first, second, _ = cells(q / size, seed)
        return smoothstep(0.3, -0.3, (second - first) * size - thick)

    def _rim(self, p: np.ndarray) -> np.ndarray:
        """Share of fat of the rim: along the side at -z and round one end."""
        x, _, z = np.moveaxis(p, -1, 0)
        angle = np.arctan2(z / HALF_WIDTH, x / HALF_LENGTH)
        along = smoothstep(0.1, 0.8, np.cos(angle + 1.9))
        deep = (RIM + 4) * along * (1 + 0.3 * noise(p / 9, self.seed + 21)) - 4
        bay = 4.0 * np.exp(-(length((x - 9) / 7, (z + 22) / 8) ** 2))
        return smoothstep(-0.5, 0.5, self.outline(p) + deep + bay)

    def tissues(self, p: np.ndarray) -> dict[str, np.ndarray]:
        """Share of each tissue, summing to 1: "lean meat", "fat"."""
        fat = np.clip(self.fat(p), 0, 1)
        return {"lean meat": 1 - fat, "fat": fat}


MODELS["meat"] = Meat, MEAT_BOX, 1.4
VIEWS["meat"] = View((10, 120, 110), (-1, 7, 2), 34, "studio", 0.3, 0)
