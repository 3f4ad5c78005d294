"""Material files of any content are read as written, or refused with their name; searched by Hypothesis."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from halfspace_sss.materials.files import read

search = settings(max_examples=100, deadline=None, derandomize=True)
VALUE = st.floats(0, 1e6)
NAMES = st.text(st.characters(codec="ascii", categories=("L", "N")), min_size=1, max_size=12)


def _read(text: str | bytes) -> list:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wax.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return list(read(path))


@search
@given(NAMES, VALUE, VALUE, st.floats(-0.99, 0.999), st.floats(0.5, 3.0))
def test_a_file_is_read_as_it_was_written(name: str, sigma_s: float, sigma_a: float, g: float, eta: float) -> None:
    text = 'set = "mine"\nunit = "1/mm"\nsource = "measured"\n'
    text += f'[[material]]\nname = "{name}"\nsigma_s = {sigma_s!r}\nsigma_a = {sigma_a!r}\n'
    text += f"g = {g!r}\neta = {eta!r}\n"
    if sigma_s + sigma_a < 1e-18:
        with pytest.raises(ValueError, match="wax.toml"):
            _read(text)
        return
    (material,) = _read(text)
    medium = material.medium
    kept = g if sigma_s > 0 else 0.0  # without scattering there is no phase function
    assert (material.name, medium.sigma_s, medium.sigma_a, medium.g, medium.eta) == (name, sigma_s, sigma_a, kept, eta)


@search
@given(st.one_of(st.text(max_size=200), st.binary(max_size=200)))
def test_whatever_else_a_file_holds_is_refused_by_its_name(content: str | bytes) -> None:
    with pytest.raises(ValueError, match="wax.toml"):
        _read(content.encode("utf-8", "replace") if isinstance(content, str) else content)
