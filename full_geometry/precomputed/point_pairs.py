"""Pairs of places between which S is asked once more, along directions that light comes from at the entry.

A few entries of each point are chosen in proportion to the light that they bring, and for each one of the
directions that light was gathered along where it is: by systematic sampling, as the entries themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import GOLDEN
from full_geometry.geometry.points import EntrySample, SurfacePoint, channel_mean, of_rows
from full_geometry.objects.objects import TranslucentObject
from halfspace_sss.arrays import aligned

COUNT = 3 * 2**14  # pairs of all points,
FEWEST = 6  # of a point,
ANY = 0.1  # and of them by no light


class Rays(NamedTuple):
    """Directions along which light was gathered at points, those of each point beside each other.
    `w`: all directions. `light`: a(mu) mu L over their density and number. `brightness`: its mean over channels,
    (points, directions). `whole`: its sum at each point, (points, channels)."""

    w: mi.Vector3f
    light: mi.Spectrum
    brightness: np.ndarray
    whole: np.ndarray

    @classmethod
    def of(cls, w: mi.Vector3f, light: mi.Spectrum, whole: np.ndarray) -> Rays:
        """Rays with their brightness; all but that stays on the device."""
        brightness = channel_mean(light)
        dr.eval(w, light, brightness)
        return cls(w, light, np.array(brightness).reshape(len(whole), -1), whole)

    def some(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions and light of rays by their numbers, (n, 3) and (n, channels)."""
        found = dr.gather(tuple, (self.w, self.light), aligned(mi.UInt32, numbers))
        dr.eval(found)
        w, light = (np.stack([np.array(v) for v in part], axis=1) for part in found)
        return w, light


class LitPairs(NamedTuple):
    """Chosen pairs, with light.
    `row`, `number`: point of the exit, and number of the entry in those of all points. `share`: of them over their
    probability. `w`: direction of light at the entry, (pairs, 3). `colour`: light along that over the mean of such
    light there, (pairs, channels)."""

    row: np.ndarray
    number: np.ndarray
    share: np.ndarray
    w: np.ndarray
    colour: np.ndarray


def lit_pairs(brought: np.ndarray, point: np.ndarray, rays: Rays) -> LitPairs:
    """Pairs for light.
    `brought`: by entries, (points, entries). `point`: that each is nearest to. `rays`: to points."""
    # ---- n entries of each point, of probability (1 - ANY) light / Σ light + ANY / entries
    (rows, each), n = brought.shape, max(COUNT // len(brought), FEWEST)
    row = np.repeat(np.arange(rows), n)
    by_light = np.maximum(brought, 0) / np.maximum(np.maximum(brought, 0).sum(axis=1, keepdims=True), 1e-30)
    probability = (1 - ANY) * by_light + ANY / each
    number = _systematic(probability, row, (np.arange(rows)[:, None] * GOLDEN % 1.0 + np.arange(n)).ravel() / n)

    # ---- a stratified uniform number for each of the pairs with entries at one point, in random order
    at = point.ravel()[number]
    order = np.lexsort((np.random.default_rng(rows).random(len(at)), at))
    sorted_at, u = at[order], np.empty(len(at))
    u[order] = (np.arange(len(at)) - np.searchsorted(sorted_at, sorted_at) + 0.5) / np.bincount(at)[sorted_at]

    # ---- a ray of light to that point in proportion to its light, and its colour over that of all
    w, light = rays.some(_systematic(rays.brightness, at, u))
    mean = rays.whole[at]
    colour = light * (mean.mean(axis=1) / np.maximum(light.mean(axis=1), 1e-30))[:, None] / np.maximum(mean, 1e-30)
    share = 1 / (n * probability.ravel()[number])
    return LitPairs(row, number, share, w, colour)


def _systematic(weights: np.ndarray, row: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Numbers of items of rows (rows, items), in proportion to their weights, for uniform numbers."""
    # one cumulative sum over all rows; u of a row is looked up between its ends
    summed = np.cumsum(np.maximum(weights, 0), axis=1, dtype=float)
    whole, n = summed[:, -1].copy(), weights.shape[1]
    before = np.concatenate([[0], np.cumsum(whole)[:-1]])
    summed += before[:, None]
    return np.clip(np.searchsorted(summed.ravel(), before[row] + u * whole[row], "right"), row * n, row * n + (n - 1))


class EntryPairs(NamedTuple):
    """All entries of points and their exits, on an object without textures.
    `object`: that both are on. `out`: exits of points and their faces, given those and directions. `w_o`: directions,
    (points, entries, 3). `entries`: given their numbers."""

    object: TranslucentObject
    out: Callable[[mi.UInt32, mi.Vector3f], tuple[SurfacePoint, mi.UInt32]]
    w_o: np.ndarray
    entries: Callable[[mi.UInt32], EntrySample]

    def S(self, lit: LitPairs) -> tuple[np.ndarray, np.ndarray]:
        """S over the density of entries, (pairs, channels), and the cosines of light; both 0 below the surface."""
        # the exit along w_o, the entry with light along w
        obj, on = self.object, mi.Bool(True)
        w_o = self.w_o[lit.row, lit.number % self.w_o.shape[1]]
        row, number = aligned(mi.UInt32, lit.row), aligned(mi.UInt32, lit.number)
        w_o, w = (of_rows(mi.Vector3f, v) for v in (w_o, lit.w))
        entry = self.entries(number)
        at, prepared = entry.facing(w), obj.transport.prepare(self.out(row, w_o)[0], on)

        # S(x_i, w; x_o, w_o) over the density of the entry
        active = (dr.dot(w, entry.n) > 0) & (entry.weight > 0)
        S = mi.Spectrum(dr.select(active, obj.transport.S(prepared, at, active) * entry.weight, 0))
        mu = dr.select(active, at.mu, 0)
        dr.eval(S, mu)
        S = np.nan_to_num(np.array(S, dtype=np.float32).T, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        return S, np.array(mu)
