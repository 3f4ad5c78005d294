"""Fig. 11: equal time for every method, denoised images, and what the clock of its renders does."""

from __future__ import annotations

import io
import sys
from typing import Any

import numpy as np
import pandas
import pytest

from benchmarks import timed
from benchmarks.methods import VOLUMES, contender
from benchmarks.published import fig11
from benchmarks.timed import alternating, pass_size
from figures.parts.part import Part, Result, Task
from full_geometry.trade.denoising import denoised, guides
from halfspace_sss.backend import BackendError

mi = pytest.importorskip("mitsuba")

pytestmark = pytest.mark.slow
SIZE, METHODS = 24, [VOLUMES[0], VOLUMES[3], "neural"]


def _result(part: Part, folder: Any) -> Result:
    """The function of a part, run as the machinery runs it."""
    found = part.function(Task(part.params, folder))
    images = {name: v for name, v in found.items() if isinstance(v, np.ndarray)}
    return Result(images, {name: v for name, v in found.items() if name not in images}, 1.0, part.work)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Result]:
    """All parts of one material, small and short."""
    pytest.importorskip("mitsuba_oidn")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fig11, "MATERIALS", ("ketchup",))
        patch.setattr(fig11, "METHODS", tuple(METHODS))
        for name, value in (("SIZES", SIZE), ("SECONDS", 0.2), ("TRUTH_SPP", 64)):
            patch.setitem(getattr(fig11, name), "draft", value)
        parts = fig11.parts("draft")
    return {part.name: _result(part, tmp_path_factory.mktemp("part")) for part in parts}


def test_every_method_has_a_raw_and_a_denoised_image_that_differ(results: dict[str, Result]) -> None:
    found = results["ketchup, equal time"]
    cover = results["ketchup, truth"].images["cover"] > 0
    assert 0.2 < cover.mean() < 0.9
    for name in METHODS:
        key = name.replace(" ", "_")
        raw, clean = found.images[f"{key}-raw"], found.images[f"{key}-denoised"]
        assert raw.shape == clean.shape == (SIZE, SIZE, 3)
        assert np.isfinite(clean).all() and clean.min() >= 0
        assert np.abs(raw - clean)[cover].mean() > 0.02 * raw[cover].mean()
        about = found.numbers["methods"][name]
        assert about["spp"] >= 1 and about["seconds"] > 0 and about["seconds of denoising"] > 0


def test_the_figure_its_page_and_its_table_are_drawn(results: dict[str, Result]) -> None:
    files = fig11.draw(results)
    assert files["fig11.pdf"].startswith(b"%PDF") and files["fig11.png"].startswith(b"\x89PNG")
    table = pandas.read_csv(io.StringIO(files["fig11.csv"]))
    assert list(table["state"]) == ["truth"] + ["raw", "denoised"] * len(METHODS)
    assert {"FLIP", "relMSE", "spp", "seconds", "shown"} <= set(table.columns)
    assert table["shown"].sum() == 1 + 2 * (len(METHODS) - 1)  # one of the two settings of volpathmis
    assert np.isfinite(table.loc[1:, "relMSE"]).all()
    assert "Neural half-space, denoised" in files["fig11.html"]


def test_denoising_brings_a_noisy_image_nearer_to_the_truth() -> None:
    pytest.importorskip("mitsuba_oidn")
    fig11.prepare()
    albedo, normal = guides(contender("standard_dipole", "marble", 32, "even sky"))
    assert (albedo.max(axis=(0, 1)) < 0.95).all() and np.ptp(albedo.max(axis=(0, 1))) > 0.02  # of marble, not the cover
    clean = 0.5 * albedo
    noisy = clean * np.random.default_rng(0).exponential(1.0, clean.shape)
    found, seconds = denoised(noisy, albedo, normal)
    assert np.mean((found - clean) ** 2) < 0.2 * np.mean((noisy - clean) ** 2)
    assert seconds > 0
    with pytest.raises(ValueError, match="normal must have the shape of the image"):
        denoised(noisy, albedo, normal[:5])


def test_without_the_denoiser_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    for part in [part for part in fig11.parts("draft") if part.name.endswith(("truth", "equal time"))][:2]:
        with pytest.raises(
            BackendError, match=r'^denoising needs mitsuba-oidn: pip install "halfspace-sss\[figures\]"$'
        ):
            part.function(Task(part.params, tmp_path))


class Clock:
    """Renders that take a fixed time for themselves and for each sample, of noise with variance 1 / spp."""

    def __init__(self, patch: pytest.MonkeyPatch, own: float, each: float) -> None:
        self.asked: list[int] = []

        def rendered(scene: Any, spp: int, *seed: int) -> tuple[np.ndarray, float]:
            self.asked.append(spp)
            rng = np.random.default_rng(seed)
            return rng.standard_normal((16, 16, 3)) / np.sqrt(spp), own + each * spp

        patch.setattr(timed, "rendered", rendered)


class Sixteen:
    """A scene of 16 x 16 pixels."""

    def sensors(self) -> list[Any]:
        return [self]

    def film(self) -> Any:
        return self

    def crop_size(self) -> tuple[int, int]:
        return 16, 16


@pytest.mark.parametrize(
    ("own", "each", "expected"), [(0.1, 0.01, 32), (0.3, 0.01, 16), (0.0, 2.0, 1), (0.0, 1e-9, 2**14)]
)
def test_a_pass_takes_the_time_that_it_is_given(own: float, each: float, expected: int, monkeypatch: Any) -> None:
    Clock(monkeypatch, own, each)
    assert pass_size(Sixteen(), 0.5) == expected


def test_errors_fall_with_the_time_and_every_scene_ends_at_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, errors = Clock(monkeypatch, 0.0, 0.01), []
    for seconds in (0.1, 1.0, 10.0):
        found = alternating({"a": None, "b": None}, {"a": 4, "b": 5}, 3, seconds=seconds)
        assert all(abs(f.seconds - seconds) <= 0.026 for f in found.values())
        errors.append(float(np.mean(found["a"].image ** 2)))
    assert errors[0] > 5 * errors[1] > 25 * errors[2]
    assert clock.asked[:4] == [4, 5, 4, 5]
    found = alternating({"a": None}, {"a": 4}, 3, seconds=0.12)["a"]
    assert found.spp == 12 and found.seconds == pytest.approx(0.12)


def test_a_budget_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="seconds"):
        alternating({}, {}, 0, seconds=-1.0)


def test_the_paper_takes_more_time() -> None:
    draft, paper = fig11.parts("draft"), fig11.parts("paper")
    assert all(b.work > a.work for a, b in zip(draft, paper))
    renders = [pair for pair in zip(draft, paper) if pair[0].name.endswith(("truth", "equal time"))]
    assert len(renders) == 4 and all(b.work > 10 * a.work for a, b in renders)
