"""The job of a rendering, and the effort by which techniques for it are measured."""

from __future__ import annotations

from dataclasses import dataclass

from halfspace_sss.checks import check_count, check_interval

EXITS = 480  # few: their choice makes 3 % of a bias uncertain, and each gets the more samples
TRACED_SHARE = 0.4  # of the time, for the walks that all techniques are compared with


@dataclass(frozen=True)
class Job:
    """A job of rendering.

    Args:
        tolerance: relative error of radiance, bias and noise together.
        images: of the object, each as large as the film.
        seconds: that all of them may take; None for no limit.
        count_training: whether the time of a training that has been done counts too.
    """

    tolerance: float = 0.05
    images: int = 1
    seconds: float | None = None
    count_training: bool = True

    def __post_init__(self) -> None:
        check_interval("tolerance", self.tolerance, 1e-4, 10.0)
        check_count("images", self.images, 1)
        if self.seconds is not None:
            check_interval("seconds", self.seconds, 1e-3, 1e9)


@dataclass(frozen=True)
class Effort:
    """The effort by which a scene is measured.

    Args:
        seconds: for each object, shared by all techniques, compilation left out.
        samples: of each exit by each technique, in place of seconds; the outcome then depends on the seed alone.
        exits: points of each object.
        traced: share of the time for walks.
        sensor: number of the sensor.
        seed: of everything; what depends on the clock is how many samples are taken.
    """

    seconds: float = 4.0
    samples: int | None = None
    exits: int = EXITS
    traced: float = TRACED_SHARE
    sensor: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0)
        check_count("exits", self.exits, 32)
        check_count("sensor", self.sensor, 0)
