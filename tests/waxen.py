"""A bunny of wax, and samplers of its entries with random weights: what must hold, holds for any."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from full_geometry.objects.objects import TranslucentObject, object_of
from full_geometry.transport.features import n_side
from full_geometry.transport.patches import Patches, PatchSampler, cluster
from full_geometry.transport.storing import frame_of
from halfspace_sss import Medium

BUNNY = Path(__file__).parents[1] / "figures" / "assets" / "bunny.ply"
WAX = Medium(np.array([0.95, 0.8, 0.6]), np.array([0.05, 0.2, 0.4]), 0.0, 1.4)


def wax_bunny() -> TranslucentObject:
    mi.set_variant("llvm_ad_rgb")
    return object_of(mi.load_dict({"type": "ply", "filename": str(BUNNY)}), WAX)


def random_layers(rng: np.random.Generator, W: str, b: str, sizes: list[int], spread: float = 1.0) -> dict:
    """Matrices W_k and biases b_k of a network; `spread` of the biases."""
    found = {}
    for k, (i, j) in enumerate(zip(sizes, sizes[1:])):
        found |= {f"{W}_{k}": rng.standard_normal((j, i)) / np.sqrt(i), f"{b}_{k}": spread * rng.standard_normal(j)}
    return found


def random_patches(obj: TranslucentObject, n: int, rng: np.random.Generator, spread: float = 1.0) -> PatchSampler:
    frame = frame_of(obj)
    patches = Patches(obj, frame, cluster(obj, frame, n))
    return PatchSampler(frame, patches, random_layers(rng, "V", "c", [n_side(3), 16, n], spread))
