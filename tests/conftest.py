"""What the tests share: every test with the argument `name` runs once for each model of the one list."""

from __future__ import annotations

import csv
from importlib import resources

import numpy as np
import pytest

import halfspace_sss


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "name" in metafunc.fixturenames:
        metafunc.parametrize("name", halfspace_sss.models())


@pytest.fixture(scope="session")
def truths() -> list[dict[str, str]]:
    """Rows of the packaged reference values."""
    text = resources.files("halfspace_sss").joinpath("data/truths.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


@pytest.fixture
def queries():
    """`queries(n, medium)`: r in mm (1e-3 to 30 mean free paths), mu_i, phi_i, mu_o, phi_o, the same on every call."""

    def make(n: int, medium: halfspace_sss.Medium, seed: int = 20240703) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        r = 10 ** rng.uniform(-3, 1.5, n) / np.min(medium.sigma_t)
        mu_i, mu_o = rng.uniform(0.02, 1, (2, n))
        phi_i, phi_o = rng.uniform(-np.pi, np.pi, (2, n))
        return [r, mu_i, phi_i, mu_o, phi_o]

    return make
