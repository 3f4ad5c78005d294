"""The objects whose medium varies: a mandarin with two segments taken out and a croissant; lengths in mm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from benchmarks.modelling.meshes import (
    Box,
    cells,
    cut,
    ellipsoid,
    fbm,
    join,
    length,
    noise,
    overlap,
    ridges,
    ring_noise,
    rotated,
    smoothstep,
    twisted,
)

MANDARIN_BOX = Box((-33.0, -1.5, -31.0), (40.0, 44.0, 66.0))
RADIUS, HALF = 28.0, 20.5  # of the whole fruit, across and up
N = 10  # segments
OUT = (0, 1)  # those taken out
MEMBRANE = 0.45  # thickness, mm
ROUND = 5.5  # of the edges of a segment
REACH = 27.0  # from the middle of a segment taken out to where its distance no longer counts, mm
TWIST = 0.005  # of the whole about its axis, radians per mm
CREASE = 0.35  # filling of the grooves between segments, mm
CORE = 2.6  # radius of the hollow in the middle
PIP = (2.1, 4.6, 1.6)  # half axes
LAID = (((-13.0, 42.0), -0.5, 1), ((14.0, 43.0), 2.2, -1))  # of each: x and z of its middle, turn, side that is down


@dataclass(frozen=True)
class Mandarin:
    """The distances and the tissues of a peeled mandarin, about 56 mm wide and 40 mm tall, with a given seed.
    Two of its segments are taken out and laid beside it. Each segment is flesh of juice sacs in a thin membrane, with
    white strands outside and a pip or two at its inner edge."""

    seed: int = 0

    @cached_property
    def edges(self) -> np.ndarray:
        """Azimuths between the segments, of different widths, N + 1 of them; the first is opposite to the front."""
        rng = np.random.default_rng([self.seed, 5])
        widths = rng.uniform(0.8, 1.2, N)
        edges = np.concatenate([[0.0], np.cumsum(widths / widths.sum() * 2 * np.pi)])
        return edges - edges[2] / 2 + np.pi / 2  # the gap of the first two looks along +z

    def distance(self, p: np.ndarray) -> np.ndarray:
        """Of the surface, strands included."""
        result = np.full(p.shape[:-1], np.inf)
        for near, q, candidates in self._views(p):
            shape = self._shape_of(q)
            d = np.minimum.reduce(parts := [self._segment(q, k, shape) for k in candidates])
            if len(parts) == 2:
                d = join(*parts, CREASE)
            close = np.abs(d) < 3.0
            d[close] -= self._relief(q[close], candidates[0][close])
            result[near] = np.minimum(result[near], d)
        return result

    def _views(self, p: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, list[np.ndarray]]]:
        """For the whole and each segment taken out: which points are near, those in the fruit's own coordinates as they
        were before, and the number of the nearest segment of each and of the next one to it."""
        everywhere = np.ones(p.shape[:-1], dtype=bool)
        q = twisted(p - np.array([0.0, HALF + 0.2, 0.0]), TWIST)
        yield everywhere, q, self._nearest(q)
        for k, ((x, z), _, _), height in zip(OUT, LAID, self._heights):
            r = length(p[..., 0] - x, p[..., 1], p[..., 2] - z)
            near = r < REACH
            yield near, self._put_back(p[near] - np.array([0.0, height, 0.0]), k), [np.full(int(near.sum()), k)]

    def _nearest(self, q: np.ndarray) -> list[np.ndarray]:
        """Numbers of the nearest and the next segment of those that stayed, by azimuth."""
        first, last = self.edges[len(OUT)], self.edges[N]
        angle = np.arctan2(q[..., 2], q[..., 0])
        angle = first + np.mod(angle - first, 2 * np.pi)
        angle = np.where(angle > 0.5 * (last + first) + np.pi, first, np.minimum(angle, last))
        k = np.clip(np.searchsorted(self.edges, angle, side="right") - 1, len(OUT), N - 1)
        step = np.where(angle > 0.5 * (self.edges[k] + self.edges[k + 1]), 1, -1)
        return [k, np.clip(k + step, len(OUT), N - 1)]

    def _put_back(self, p: np.ndarray, k: int) -> np.ndarray:
        """From where a segment lies on its side, its middle at height 0, to its place in the fruit."""
        (x, z), turn, side = LAID[OUT.index(k)]
        half = 0.5 * (self.edges[k + 1] - self.edges[k])
        q = rotated(rotated(p - np.array([x, 0.0, z]), 1, -turn), 0, side * np.pi / 2)
        return rotated(q + np.array([15.0, 0.0, 0.0]), 1, side * half - (self.edges[k] + half))

    @cached_property
    def _heights(self) -> list[float]:
        """Heights at which the segments taken out rest on the floor."""
        results = []
        for k, ((x, z), _, _) in zip(OUT, LAID):
            axis = np.arange(-24.0, 24.0, 0.8)
            p = np.stack(np.meshgrid(axis + x, axis, axis + z, indexing="ij"), axis=-1).reshape(-1, 3)
            q = self._put_back(p, k)
            inside = self._segment(q, np.full(len(q), k), self._shape_of(q)) < 0
            results.append(0.4 - p[inside, 1].min())
        return results

    def _shape_of(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What all segments share: distance of the flattened ball with dents at its poles, waviness of the sides."""
        rho = length(q[..., 0], q[..., 2])
        ball = ellipsoid(q, (RADIUS, HALF, RADIUS)) + 0.3 * noise(q / 8, self.seed + 1)
        return ball + 3.2 * np.exp(-((rho / 7.0) ** 2)), 0.3 * noise(q / 10, self.seed)

    def _segment(self, q: np.ndarray, k: np.ndarray, shape: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Distance of a segment: a wedge of the ball, hollow at the middle, its edges rounded."""
        x, y, z = np.moveaxis(q, -1, 0)
        rho, half = length(x, z), 0.5 * (self.edges[k + 1] - self.edges[k])
        off = np.abs(self._off(x, z, k)) - half
        flat = np.where(off < np.pi / 2, rho * np.sin(np.maximum(off, -np.pi / 2)), rho)
        ball = shape[0] + 0.4 * ring_noise(3 * y / HALF + 2.4 * k, self.seed + 40)
        edge = np.minimum(ROUND, 0.55 * np.maximum(rho, 2.0) * half + 0.6)
        body = _overlap_by(ball, flat + shape[1] * smoothstep(0, 8, rho) * np.where(k % 2, 1, -1) * 0.5, edge)
        return overlap(body, CORE - rho, 1.5)

    def _off(self, x: np.ndarray, z: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Azimuth from the middle of segment k, in [-pi, pi)."""
        turn = np.arctan2(z, x) - 0.5 * (self.edges[k] + self.edges[k + 1])
        return np.mod(turn + np.pi, 2 * np.pi) - np.pi

    def _relief(self, q: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Height of the surface: strands, and the juice sacs that press through."""
        return 0.28 * self.strands(q, k) + 0.1 * fbm(q / 2.6, self.seed + 2, 2)

    def strands(self, q: np.ndarray, k: np.ndarray) -> np.ndarray:
        """White strands of pith on the outside of a segment, 0 to 1: along its middle and in a net about it."""
        x, y, z = np.moveaxis(q, -1, 0)
        rho = length(x, z)
        ball = ellipsoid(q, (RADIUS, HALF, RADIUS))
        outside = smoothstep(-3.0, -1.2, ball)
        warp = np.stack([fbm(q / 9, self.seed + 60 + i, 2) for i in range(3)], axis=-1)
        net = smoothstep(0.90, 0.975, ridges(q * np.array([1, 0.5, 1]) / 8.5 + 0.35 * warp, self.seed + 3, 1))
        patches = smoothstep(-0.35, 0.2, fbm(q / 15, self.seed + 4, 2) + 0.25 * np.abs(y) / HALF)
        across = np.abs(rho * self._off(x, z, k) + 0.9 * warp[..., 0] * 2)
        middle = smoothstep(0.75, 0.2, across) * smoothstep(-0.3, 0.35, noise(q / 7, self.seed + 5) + 0.3)
        return outside * np.maximum(net * patches, 0.9 * middle * patches)

    def tissues(self, p: np.ndarray) -> dict[str, np.ndarray]:
        """Share of each tissue, summing to 1: "mandarin flesh", "membrane", "pip"."""
        best = np.full(p.shape[:-1], np.inf)
        white, pip = np.zeros((2, *p.shape[:-1]))
        for near, q, candidates in self._views(p):
            d = self._segment(q, candidates[0], self._shape_of(q))
            nearer = d < best[near]
            here = np.flatnonzero(near)[nearer]
            q, k = q[nearer], candidates[0][nearer]
            best[here], white[here], pip[here] = d[nearer], self._white(q, d[nearer], k), self._pip(q, k)
        membrane = (1 - pip) * white
        return {"mandarin flesh": 1 - pip - membrane, "membrane": membrane, "pip": pip}

    def _white(self, q: np.ndarray, d: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Share of white tissue: the membrane, strands on it, walls of the sacs, the edge at the core."""
        rho = length(q[..., 0], q[..., 2])
        away = q / np.maximum(length(*np.moveaxis(q, -1, 0)), 1e-6)[..., None]
        first, second, _ = cells(away * 7.5 + (rho / 9.0)[..., None], self.seed + 6)
        walls = 0.3 * smoothstep(0.16, 0.0, second - first)
        skin = 0.2 * smoothstep(-MEMBRANE, -0.2 * MEMBRANE, d)
        strands = self.strands(q, k) * smoothstep(-1.1, -0.5, d)
        core = 0.9 * smoothstep(CORE + 2.2, CORE + 0.8, rho)
        return np.clip(np.maximum.reduce([walls, skin, strands, core]), 0, 1)

    def _pip(self, q: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Share of pip: in about two segments of three one near the core."""
        result = np.zeros(q.shape[:-1])
        for number in range(N):
            rng = np.random.default_rng([self.seed, 9, number])
            along, up, lean = CORE + rng.uniform(4.5, 7.0), rng.uniform(-5, 5), rng.uniform(-0.4, 0.4)
            mine = k == number
            if rng.random() < 0.65 and mine.any():
                at = rotated(q[mine], 1, 0.5 * (self.edges[number] + self.edges[number + 1])) - np.array([along, up, 0])
                result[mine] = smoothstep(0.3, -0.3, ellipsoid(rotated(at, 2, lean), PIP))
        return result


def _overlap_by(a: np.ndarray, b: np.ndarray, blend: np.ndarray) -> np.ndarray:
    """Intersection whose edge is rounded by a blend that varies in space."""
    return np.maximum(a, b) + np.maximum(blend - np.abs(a - b), 0) ** 2 / (4 * blend)


CROISSANT_BOX = Box((-55.0, -1.5, -22.0), (52.0, 40.0, 66.0))
ARC, ARM = 40.0, 72.0  # radius of the bent axis, half its length along the arc
THICK, TIP = 22.0, 6.5  # radius in the middle and at the tips
FLAT = 0.86  # height over width
BANDS = 3.6  # layers to be seen on each side of the middle
MIDDLE = ARC + 6.0  # z of the centre of the arc
STEP = 2.8  # height of a layer's edge
CUT = 0.56  # of the reach, where the tip is cut off
CRUST = 1.5  # thickness, mm


@dataclass(frozen=True)
class Croissant:
    """The distances and the tissues of a croissant with a given seed, about 102 mm across, 79 mm deep and 37 mm tall.
    One tip is cut off: layered crust, crumb with pores."""

    seed: int = 0

    def _axis(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Place along the axis (-1 to 1), the two coordinates across it, outwards and up, and the radius there."""
        x, y, z = np.moveaxis(p, -1, 0)
        z = MIDDLE - z  # the tips bend towards +z
        u = np.arctan2(x, z) * ARC / ARM
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
        end = length(np.maximum(np.abs(u) - 1, 0) * ARM, a, b)
        rod = np.where(np.abs(u) > 1, end, length(a, b)) - radius
        rod = 0.8 * rod
        return overlap(rod, -p[..., 1], 4.0)

    def _relief(self, p: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Height of fine layers and blisters, mm."""
        fine = 0.4 * np.sin(2 * np.pi * 7 * number + 2.2 * fbm(p / 9, self.seed + 1, 2))
        return fine * smoothstep(-0.4, 0.4, noise(p / 11, self.seed + 2)) + 0.6 * fbm(p / 6, self.seed + 3, 3)

    def _beyond(self, p: np.ndarray) -> np.ndarray:
        """Distance of the half-space that was cut off; < 0 there."""
        angle = CUT * ARM / ARC
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
        result = np.full(p.shape[:-1], 1e3)
        near = np.abs(deep) < 6
        a, b, deep = a[near], b[near], deep[near]
        best = np.full(a.shape, 1e3)
        for (r, turn), size in zip(*self._pores):
            da, db = a - r * np.cos(turn), b - r * np.sin(turn)
            across = da * np.cos(turn) + db * np.sin(turn)
            along = -da * np.sin(turn) + db * np.cos(turn)
            best = np.minimum(best, (length(across, along / 1.7, deep / 1.4) - size) * 0.9)
        result[near] = best
        return result

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
        q = np.stack([u * ARM / 4.2, length(a, b) / 1.6, np.arctan2(b, a) * 3.0], axis=-1)
        first, second, number = cells(q + 0.4 * fbm(p / 4, self.seed + 7, 2)[..., None], self.seed + 8)
        pores = (1 - crust) * smoothstep(0.12, 0.35, second - first) * smoothstep(0.2, 0.6, number)
        dark = crust * self.browned(p)
        return {"crumb": 1 - crust - pores, "crumb pores": pores, "pale crust": crust - dark, "dark crust": dark}
