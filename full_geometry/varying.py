"""Media that vary in space: what tells one from another, wherever the object stands."""

from __future__ import annotations

import hashlib

import numpy as np

from full_geometry.subject import Subject
from halfspace_sss.rendering.surface.varying import grid_values

__all__ = ["DEPTHS", "check_same", "digest_of_grids", "probed"]

DEPTHS = (1.0, 0.7, 0.4)  # of the anchors of a shape, over their distance from the middle of them all
CLOSE, MOST_FAR = 1e-2, 0.03  # relative to the largest value; share of points, for voxels that are not interpolated


def digest_of_grids(subject: Subject) -> str:
    """Of the voxels and of the ratios of what they are multiplied by; empty for a homogeneous medium."""
    medium = subject.varying
    if medium is None:
        return ""
    found = hashlib.sha256()
    for volume in (medium.density, medium.albedo_volume):
        voxels = np.zeros(0) if volume is None else np.ascontiguousarray(grid_values(volume), dtype=np.float32)
        found.update(str(voxels.shape).encode() + voxels.tobytes())
    ratios = (*medium.factor / medium.factor.max(), *medium.albedo)
    found.update("|".join(f"{v:.6g}" for v in ratios).encode())
    return found.hexdigest()[:16]


def probed(subject: Subject, anchors: np.ndarray) -> np.ndarray:
    """sigma_t and sigma_s times sqrt(area) at points that move with the shape, (2 channels, points); none if constant.

    They tell grids that lie elsewhere in the object, or are interpolated in another way.
    """
    import mitsuba as mi

    if subject.varying is None:
        return np.zeros((0, 0), dtype=np.float16)
    centre = anchors.mean(axis=0)
    points = np.concatenate([centre + depth * (anchors - centre) for depth in DEPTHS])
    values = np.concatenate(subject.varying.coefficients(mi.Point3f(points.T.astype(np.float32))))
    return (values * np.sqrt(subject.found.area)).astype(np.float16)


def check_same(trained: np.ndarray, here: np.ndarray) -> None:
    """ValueError if the coefficients at the points of `probed` are not those of training."""
    if trained.shape == here.shape:
        scale = np.abs(trained.astype(float)).max(initial=1e-30)
        gap = np.abs(trained.astype(float) - here.astype(float))
        if trained.size == 0 or np.mean(gap > CLOSE * scale) <= MOST_FAR:
            return
        raise ValueError(
            "the medium must vary in the object as trained, got grids placed, scaled or interpolated in another way "
            f"(coefficients differ by up to {gap.max() / scale:.2g} of the largest)"
        )
    raise ValueError(f"coefficients must be known at {trained.shape} points, as trained, got {here.shape}")
