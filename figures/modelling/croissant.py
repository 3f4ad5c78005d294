"""A croissant, about 102 mm across, 79 mm deep and 37 mm tall, one tip cut off: layered crust, crumb with pores."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from full_geometry.learning.meshes import Box, cells, cut, fbm, length, noise, overlap, smoothstep

__all__ = ["BOX", "Croissant"]

BOX = Box((-55.0, -1.5, -22.0), (52.0, 40.0, 66.0))
ARC, REACH = 40.0, 72.0  # radius of the bent axis, half its length along the arc
THICK, TIP = 22.0, 6.5  # radius in the middle and at the tips
FLAT = 0.86  # height over width
BANDS = 3.6  # layers to be seen on each side of the middle
MIDDLE = ARC + 6.0  # z of the centre of the arc
STEP = 2.8  # height of a layer's edge
CUT = 0.56  # of the reach, where the tip is cut off
CRUST = 1.5  # thickness, mm


@dataclass(frozen=True)
class Croissant:
    """The distances and the tissues of a croissant with a given seed."""

    seed: int = 0

    def _axis(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Place along the axis (-1 to 1), the two coordinates across it, outwards and up, and the radius there."""
        x, y, z = np.moveaxis(p, -1, 0)
        z = MIDDLE - z  # the tips bend towards +z
        u = np.arctan2(x, z) * ARC / REACH
        size = TIP + (THICK - TIP) * np.clip(1 - np.abs(u) ** 1.7, 0, 1) ** 0.8
        return u, length(x, z) - ARC, (y - 0.86 * FLAT * size) / FLAT, size

    def layers(self, u: np.ndarray, turn: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Number of the layer that is outermost, counted from the middle; its fraction goes from edge to edge."""
        lean = 0.42 * np.cos(turn - 1.1) * np.tanh(4 * u) / np.maximum(np.abs(np.tanh(4 * u)), 1e-6)
        wobble = 0.10 * noise(p / 13, self.seed)
        return BANDS * np.abs(u) ** 0.92 + 0.5 + lean * np.minimum(np.abs(u) * 4, 1) + wobble

    def distance(self, p: np.ndarray) -> np.ndarray:
        """Of the surface, with the cut and its pores."""
        whole = self.whole(p)
        pores = self.pores(p)
        return cut(cut(whole, self._beyond(p), 0.8), pores, 0.25)

    def whole(self, p: np.ndarray) -> np.ndarray:
        """Distance before the tip was cut off."""
        u, a, b, size = self._axis(p)
        turn = np.arctan2(b, a)
        number = self.layers(u, turn, p)
        f = number - np.floor(number)
        lip = smoothstep(0.0, 0.85, f) * smoothstep(1.0, 0.93, f) - 0.5
        grow = 0.35 + 0.65 * size / THICK
        radius = size + STEP * grow * lip + self._relief(p, number)
        end = length(np.maximum(np.abs(u) - 1, 0) * REACH, a, b)
        rod = np.where(np.abs(u) > 1, end, length(a, b)) - radius
        rod = 0.8 * rod
        return overlap(rod, -p[..., 1], 4.0)

    def _relief(self, p: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Height of fine layers and blisters, mm."""
        fine = 0.4 * np.sin(2 * np.pi * 7 * number + 2.2 * fbm(p / 9, self.seed + 1, 2))
        return fine * smoothstep(-0.4, 0.4, noise(p / 11, self.seed + 2)) + 0.6 * fbm(p / 6, self.seed + 3, 3)

    def _beyond(self, p: np.ndarray) -> np.ndarray:
        """Distance of the half-space that was cut off; < 0 there."""
        angle = CUT * REACH / ARC
        normal = np.array([np.cos(angle), 0.0, np.sin(angle)])
        through = np.array([ARC * np.sin(angle), 0.0, MIDDLE - ARC * np.cos(angle)])
        return -(p - through) @ normal

    @cached_property
    def _pores(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres on the cut and half axes (along the cut's radius, round it) of the pores."""
        rng = np.random.default_rng([self.seed, 4])
        r, turn = 13.0 * np.sqrt(rng.random(400)), rng.uniform(0, 2 * np.pi, 400)
        size = 0.5 + 2.0 * rng.random(400) ** 2.5
        kept: list[int] = []
        for k in range(400):
            apart = np.hypot(
                r[k] * np.cos(turn[k]) - r[kept] * np.cos(turn[kept]),
                r[k] * np.sin(turn[k]) - r[kept] * np.sin(turn[kept]),
            )
            if np.all(apart > 1.5 * (size[k] + size[kept]) + 0.3) and r[k] + 1.4 * size[k] < 13.0:
                kept.append(k)
        return np.stack([r[kept], turn[kept]], axis=1), size[kept]

    def pores(self, p: np.ndarray) -> np.ndarray:
        """Distance of the pores that open on the cut, longer along the layers than across."""
        deep = self._beyond(p)
        u, a, b, _ = self._axis(p)
        found = np.full(p.shape[:-1], 1e3)
        near = np.abs(deep) < 6
        a, b, deep = a[near], b[near], deep[near]
        best = np.full(a.shape, 1e3)
        for (r, turn), size in zip(*self._pores):
            da, db = a - r * np.cos(turn), b - r * np.sin(turn)
            across = da * np.cos(turn) + db * np.sin(turn)
            along = -da * np.sin(turn) + db * np.cos(turn)
            best = np.minimum(best, (length(across, along / 1.7, deep / 1.4) - size) * 0.9)
        found[near] = best
        return found

    def browned(self, p: np.ndarray) -> np.ndarray:
        """How dark the crust is, 0 to 1: the lips of the layers and the top most, the valleys and the base least."""
        u, a, b, size = self._axis(p)
        turn = np.arctan2(b, a)
        number = self.layers(u, turn, p)
        f = number - np.floor(number)
        lips = smoothstep(0.1, 0.8, f)
        fine = 0.5 + 0.5 * np.sin(2 * np.pi * 7 * number + 2.2 * fbm(p / 9, self.seed + 1, 2))
        up = smoothstep(-0.9, 0.8, np.sin(turn))
        return np.clip(0.08 + 0.55 * lips * up + 0.22 * fine * up + 0.4 * fbm(p / 9, self.seed + 5, 3) + 0.1 * up, 0, 1)

    def tissues(self, p: np.ndarray) -> dict[str, np.ndarray]:
        """Share of each tissue, summing to 1: "crumb", "crumb pores", "pale crust", "dark crust"."""
        d = self.whole(p)
        crust = smoothstep(-CRUST, -0.4 * CRUST, d + 0.4 * noise(p / 3, self.seed + 6))
        u, a, b, _ = self._axis(p)
        q = np.stack([u * REACH / 4.2, length(a, b) / 1.6, np.arctan2(b, a) * 3.0], axis=-1)
        first, second, number = cells(q + 0.4 * fbm(p / 4, self.seed + 7, 2)[..., None], self.seed + 8)
        pores = (1 - crust) * smoothstep(0.12, 0.35, second - first) * smoothstep(0.2, 0.6, number)
        dark = crust * self.browned(p)
        return {"crumb": 1 - crust - pores, "crumb pores": pores, "pale crust": crust - dark, "dark crust": dark}
