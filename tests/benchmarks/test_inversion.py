"""Inversion: media that are to be found, Mitsuba's media beside ours, errors of textures."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
from benchmarks import inversion, inversion_textures  # noqa: E402
from benchmarks.mitsuba_media import with_media  # noqa: E402
from full_geometry.scenes.scene_files import PATH_TRACED, open_scene  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")


def test_drawn_media_are_in_their_ranges_and_differ() -> None:
    drawn = [inversion.target(k) for k in range(1, 11)]
    for name, (low, high) in inversion.DRAWN.items():
        values = np.array([medium[name] for medium in drawn])
        assert ((low < values) & (values < high)).all() and np.ptp(values) > 0.7 * (high - low)
    assert (inversion.target(0)["sigma_t"] == [20, 50, 50]).all()


def test_an_error_is_small_from_when_it_stays_so() -> None:
    times = [1.0, 2.0, 3.0, 4.0]
    assert inversion._until([40, 20, 35, 5], times, 30) == 4 and inversion._until([20, 9, 4, 2], times, 30) == 1
    assert np.isnan(inversion._until([40, 20, 35, 31], times, 30))


@pytest.mark.slow
def test_the_cube_of_mitsuba_is_that_of_the_walk() -> None:
    cube = inversion._cube(inversion.FIRST, inversion.CASES["eta 1.4, rough"], 8)
    volpath = {"type": "volpathmis", "max_depth": inversion.TARGET_DEPTH}
    scenes = open_scene(cube, PATH_TRACED), with_media(cube, 1.0, volpath)
    means = [[np.array(mi.render(s, spp=512, seed=k)).mean(axis=(0, 1)) for k in range(4)] for s in scenes]
    (a, b), noise = np.mean(means, axis=1), np.std(means, axis=1, ddof=1) / 2
    assert (np.abs(a - b) < 6 * np.hypot(*noise) + 0.005 * a).all()


def test_albedos_of_both_things_lie_between_0_and_1() -> None:
    for thing in inversion_textures.THINGS:
        albedo = inversion_textures._albedo(thing)
        assert albedo.shape[-1] == 3 and 0 < albedo.min() < 0.5 < albedo.max() < 1
