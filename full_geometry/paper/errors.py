"""How wrong the paper's network is, by the error measure of all models of an object.

Its N points come from walks, as in training, or are uniform over the area with directions by the cosine: what a
renderer has that knows nothing. Each exit is asked several times with new points, and the noise of their mean is
taken out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from full_geometry.features import Frame
from full_geometry.identity import frame_of
from full_geometry.learning.model_errors import ModelError, compare
from full_geometry.learning.radiance import Estimate, Reference
from full_geometry.paper.lights import measured_lights
from full_geometry.paper.network import PaperNetwork, Samples, placed, walk_samples
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["POINTS", "estimate", "paper_errors"]

POINTS = ("walks", "uniform")


def paper_errors(
    subject: Subject, net: PaperNetwork, truth: Reference, *, points: str = "walks", repeats: int = 16, seed: int = 0
) -> list[ModelError]:
    """Errors per channel, under constant light and lobes.

    Args:
        subject: the object.
        net: its network.
        truth: exits and their radiance.
        points: "walks" or "uniform".
        repeats: of each exit.
        seed: of the points.

    Raises:
        ValueError: an argument is out of range.
    """
    check_choice("points", points, POINTS)
    check_count("repeats", repeats, 2)
    return compare(estimate(subject, net, truth.exits, points, repeats, seed), truth.truth)


def estimate(
    subject: Subject, net: PaperNetwork, exits: SurfacePoint, points: str, repeats: int, seed: int = 0
) -> Estimate:
    """Mean radiance of exits over repeats with new points, and its variance."""
    import drjit as dr

    frame, m, found = frame_of(subject), dr.width(exits.p), []
    for k in range(repeats):
        if points == "walks":
            samples = walk_samples(subject, frame, exits, net.n, (seed, 95, k))
        else:
            samples = uniform_samples(subject, frame, exits, net.n, (seed, 96, k))
        lights = measured_lights(m, len(subject.media))
        found.append(np.stack([net.radiance(samples, light) for light in lights], axis=-1))
    values = np.array(found, dtype=float).transpose(0, 2, 1, 3)
    return Estimate(values.mean(axis=0), values.var(axis=0, ddof=1) / repeats)


def uniform_samples(subject: Subject, frame: Frame, exits: SurfacePoint, n: int, seed: tuple[int, ...]) -> Samples:
    """N points uniform over the area for each exit; the throughputs are left out."""
    import drjit as dr
    import mitsuba as mi

    m: Any = dr.width(exits.p)
    at = subject.random_points(generator(mi, m * n, pass_seed(*seed)))
    w = np.array(at.w, dtype=np.float32).T.reshape(m, n, 3)
    points = placed(frame, at, m * n).reshape(m, n, 5)
    return Samples(placed(frame, exits, m), points, w, np.zeros((m, n, len(subject.media)), np.float32))
