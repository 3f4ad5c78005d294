"""docs/add_model.md shows a whole model of objects: what it says runs, and its image is that of its S."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from full_geometry.transport import models  # noqa: E402
from halfspace_sss import Medium  # noqa: E402
from halfspace_sss.physics.reflectance import half_space_reflectance  # noqa: E402

PAGE = Path(__file__).resolve().parents[2] / "docs" / "add_model.md"


def test_the_model_of_the_page_shows_its_reflectance_under_light_from_everywhere(monkeypatch) -> None:
    monkeypatch.setattr(models, "MODELS", dict(models.MODELS))
    text = PAGE.read_text(encoding="utf-8").partition("## A model of whole objects")[2]
    (code,) = re.findall(r"^```python\n(.*?)^```", text, flags=re.M | re.S)
    found: dict = {"__name__": "__main__"}  # a module that is there, for dataclasses
    exec(compile(code, str(PAGE), "exec"), found)
    medium = Medium(9.0, 1.0)
    R = half_space_reflectance(float(medium.albedo), 0.0, float(medium.eta))
    assert np.allclose(found["image"][4:-4, 4:-4], R, rtol=1e-5)  # without variance: S mu_i over the density is R
    line = re.search(r'"mixed": (ModelEntry\(.*\)),$', code, flags=re.M)[1]
    assert eval(line, vars(models)).capabilities == models.MODELS["mixed"].capabilities
