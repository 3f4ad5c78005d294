"""Total errors over a long reference: what they are of, and that they fall."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from benchmarks import total_error as module  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")


def test_the_error_of_a_constant_factor_is_that_factor() -> None:
    R, inside = np.random.default_rng(1).random((16, 16, 3)), np.ones((16, 16), dtype=bool)
    for size in (1, 8):
        assert module._error(1.1 * R, R, np.zeros_like(R), inside, size) == pytest.approx(0.1)


def test_the_noise_of_the_reference_is_taken_off() -> None:
    rng, inside = np.random.default_rng(2), np.ones((64, 64), dtype=bool)
    truth, noise = np.ones((64, 64, 3)), np.full((64, 64, 3), 0.01)
    off = module._error(1.05 * truth, truth + 0.1 * rng.standard_normal(truth.shape), noise, inside, 1)
    assert off == pytest.approx(0.05, rel=0.1)


def test_the_error_of_blocks_is_the_noise_of_pixels_over_their_width() -> None:
    from benchmarks.time_to_error import _errors
    from full_geometry.scenes.reference_store import Reference

    rng, found = np.random.default_rng(3), Reference.empty((64, 64, 3), {}, halves=True)
    for _ in range(16):
        found = found.add(rng.gamma(4.0, 0.25, (64, 64, 3)), 1, 0.0)
    errors = _errors(found, lambda image: image)
    assert errors["raw pixels"] == pytest.approx(0.5 / 4, rel=0.05)
    assert errors["raw pixels"] / errors["raw blocks"] == pytest.approx(8, rel=0.15)
    assert errors["pixels"] == pytest.approx(errors["raw pixels"], rel=0.1)


def test_an_image_below_its_noise_is_infinitely_far_off() -> None:
    from benchmarks.time_to_error import _errors
    from full_geometry.scenes.reference_store import Reference

    rng, found = np.random.default_rng(4), Reference.empty((16, 16, 3), {}, halves=True)
    for _ in range(8):
        found = found.add(rng.standard_normal((16, 16, 3)), 1, 0.0)
    assert (found.mean**2).sum() < found.variance.sum()
    assert _errors(found, lambda image: image) == dict.fromkeys(
        ("pixels", "raw pixels", "blocks", "raw blocks"), np.inf
    )


@pytest.mark.slow
def test_precomputed_light_comes_nearer_to_the_reference_in_more_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from benchmarks.lit_objects import LitObject
    from full_geometry.trade.denoising import cover

    monkeypatch.setattr(module, "VOLUMES", module.VOLUMES[:1])
    monkeypatch.setattr(module, "PASSING", (*module.VOLUMES, module.PRECOMPUTED))
    monkeypatch.setattr(module, "MOST_SPP", 16)
    how, whole, kept = module.TotalErrors((0.25, 2.0), 4.0, 24), module._corrected, []

    def once(fresh: Any, limit: float, seed: int) -> Any:
        """16 samples for both times, which a slow machine would not reach."""
        if not kept:
            monkeypatch.setattr(module, "LEAST_SPP", module.MOST_SPP)
            scene = fresh()  # its light is gathered once
            kept.append(whole(lambda: scene, 60.0, seed))
        return kept[0]

    monkeypatch.setattr(module, "_corrected", once)
    case = LitObject("hand of potato", "windows")
    ((table, images),) = module.total_errors([case], how, tmp_path, lambda *about: None)
    assert len(images) == 2 * len(module.PASSING) + 3
    found, corrected = (
        table[table["way"] == f"{way}, raw"] for way in ("walk, light precomputed", "better_dipole, light corrected")
    )
    assert found["pixels, %"].iloc[1] < 0.7 * found["pixels, %"].iloc[0]
    pixels = np.count_nonzero(cover(module.lit_scene(case, module.SAMPLED, how.size, tmp_path)))
    for rows in (found, corrected):
        # errors of pixels are independent: the mean has their error over the root of their number
        noise = rows["pixels, %"].iloc[1] / 100 / np.sqrt(pixels)
        assert (np.abs(rows[["mean R", "mean G", "mean B"]].iloc[1] - 1) < 0.015 + 3 * noise).all()
