"""Which shapes and media the network is trained on: drawn at random, each from its own seed."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from full_geometry.neural_shape.ranges import ALBEDO, ETA, SIZE, G
from full_geometry.neural_shape.shapes.generators import TRAINING, make_shape
from full_geometry.subject import Subject
from halfspace_sss.physics.medium import Medium

__all__ = ["Drawn", "draw_medium", "draw_subject", "mean_events"]

RESOLUTION = (32, 56)  # of meshes
MESH_SHARE, SPHERE_SHARE, ISOTROPIC_SHARE = 0.08, 0.03, 0.45
DENSE_SHARE, CONSERVATIVE_SHARE, LEAST_ABSORPTION = 0.75, 0.04, 1e-4


@dataclass(frozen=True, eq=False)
class Drawn:
    """A shape filled with a medium.

    Args:
        family: of the shape, or the name of the mesh.
        subject: the object.
    """

    family: str
    subject: Subject

    def record(self) -> dict[str, Any]:
        """What it is, ready for JSON."""
        m = self.subject.media[0]
        size = float(self.subject.mean_free_paths()[0])
        return {"family": self.family, "size_in_mfp": size, "albedo": float(m.albedo), "g": float(m.g), "eta": m.eta}


def draw_medium(rng: np.random.Generator) -> tuple[float, float, float]:
    """Albedo, g and eta of a medium.

    Reduced albedo: three in four log-uniform in its distance to 1 down to 1e-4, the rest uniform; one in 25 is 1. g: 45
    in 100 are 0, the others uniform. eta: uniform, one in twenty 1.
    """
    dense = rng.random() < DENSE_SHARE
    reduced = 1 - LEAST_ABSORPTION ** rng.random() if dense else rng.uniform(*ALBEDO)
    reduced = 1.0 if rng.random() < CONSERVATIVE_SHARE else max(reduced, ALBEDO[0])
    g = 0.0 if rng.random() < ISOTROPIC_SHARE else rng.uniform(*G)
    eta = 1.0 if rng.random() < 0.05 else rng.uniform(1.05, ETA[1])
    return min(float(reduced / (1 - g + g * reduced)), 1.0), float(g), float(eta)


def draw_subject(seed: Sequence[int], families: Sequence[str] = (), meshes: Sequence[Path] = ()) -> Drawn:
    """A random shape with a random medium.

    Args:
        seed: numbers that it follows from.
        families: of generators; by default those of training, with spheres and the meshes among them.
        meshes: PLY files that some of the shapes are taken from.
    """
    import mitsuba as mi

    rng = np.random.default_rng(list(seed))
    u, path = rng.random(2), meshes[int(rng.integers(len(meshes)))] if meshes else None
    family, number = str(rng.choice(list(families or TRAINING))), int(rng.integers(2**31))
    resolution = int(rng.integers(*RESOLUTION))
    if not families and path is not None and u[0] < MESH_SHARE:
        family, shape = path.stem, mi.load_dict({"type": "ply", "filename": str(path)})
    elif not families and u[1] < SPHERE_SHARE:
        family, shape = "sphere", mi.load_dict({"type": "sphere"})
    else:
        shape = make_shape(family, number, resolution).mitsuba(family)
    size = math.exp(rng.uniform(*np.log(SIZE)))
    albedo, g, eta = draw_medium(rng)
    area = float(np.sum(np.array(shape.surface_area())))
    sigma_t = size / math.sqrt(area)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # thin sheets look open to a survey of few rays
        subject = Subject.of(shape, Medium(albedo * sigma_t, (1 - albedo) * sigma_t, g, eta))
    return Drawn(family, subject)


def mean_events(subject: Subject) -> float:
    """About how many events a walk has: at most the mean path 4 eta² V/A in mean free paths, at most 1/(1 - albedo)."""
    m = subject.media[0]
    size = float(subject.mean_free_paths()[0])
    return 5 + min(1 / max(1 - float(m.albedo), 1e-9), 0.4 * size * m.eta**2)
