"""The example of an inverse problem: a medium is found again from images of a ball, and its derivatives are right."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))

import recover_medium as example  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.slow
def test_albedo_and_mean_free_path_are_found_from_four_images() -> None:
    """Of 8 x 8 pixels; the means of the last steps, whose spread by noise is 0.004 and 8 %."""
    given = example.images(
        example.make_scene("better_dipole", 8, example.TRUE_ALBEDO, example.TRUE_MFP), spp=256, seed=10**6
    )
    assert given.shape == (4, 8, 8, 3)
    scene = example.make_scene("better_dipole", 8, example.START_ALBEDO, example.START_MFP)
    steps = list(example.recover(scene, given, steps=7, spp=64))
    albedo, mfp = (np.mean([getattr(found, name) for found in steps[4:]], axis=0) for name in ("albedo", "mfp"))
    np.testing.assert_allclose(albedo, example.TRUE_ALBEDO, atol=0.02)
    np.testing.assert_allclose(mfp, example.TRUE_MFP, rtol=0.25)
    assert steps[-1].misfit < 0.5 * steps[0].misfit


def test_no_point_at_the_limb_of_a_lamp_outshines_the_image() -> None:
    # the density of points of a lamp over its area goes to 0 where it is seen at grazing angles; with this seed one
    # sample was 17 000 times as bright as the image
    albedo, mfp = (0.9499860974003239, 0.9006099000510851, 0.6993874349780298), (1.01398178, 2.01859308, 1.52715996)
    scene = example.make_scene("neural", 24, albedo, mfp)
    image = np.array(mi.render(scene, sensor=3, spp=256, seed=63))
    assert image.max() < 20 * image.mean()
