"""Materials that are added while a process runs, and those that packages offer: which join, which are refused."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from registered import FILE

from halfspace_sss import Medium
from halfspace_sss.materials import Material, load, names
from halfspace_sss.materials import catalogue as registry


class EntryPoint:
    def __init__(self, offered):
        self.name, self.offered = "plugin", offered

    def load(self):
        if isinstance(self.offered, Exception):
            raise self.offered
        return self.offered


def test_another_material_of_the_same_name_is_refused(fresh):
    mine = Material("My Stone", Medium(1.0, 0.1), source="a note")
    assert fresh.register(mine) == ("My Stone",) and load("my-stone") is mine
    with pytest.raises(ValueError, match=re.escape("register(): key name must be new, got 'My Stone'")):
        fresh.register(Material("My Stone", Medium(1.0, 0.2), source="a note"))
    assert load("my-stone") is mine


def test_an_equal_material_can_be_registered_again(fresh):
    for _ in range(2):
        assert fresh.register(Material("My Stone", Medium(1.0, 0.1), source="a note")) == ("My Stone",)
    assert len(names()) == 49


def test_a_file_that_was_changed_and_registered_again_replaces_what_it_gave(fresh, written):
    fresh.register(written(FILE))
    fresh.register(written(FILE.replace("eta = 1.4", "eta = 1.45")))
    assert load("soap").medium.eta == 1.45 and len(names()) == 50


def test_another_file_cannot_replace_a_material(fresh, written):
    fresh.register(written(FILE))
    with pytest.raises(
        ValueError, match="other.toml: key name must be new, got 'soap', which is 'soap' of .*mine.toml"
    ):
        fresh.register(written(FILE.replace("eta = 1.4", "eta = 1.45"), "other.toml"))


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no devices here")
@pytest.mark.parametrize("kind", ["device", "pipe"])
def test_what_has_no_end_is_not_read(fresh, monkeypatch, tmp_path, kind):
    path = Path("/dev/zero") if kind == "device" else tmp_path / "pipe"
    if kind == "pipe":
        os.mkfifo(path)
    monkeypatch.setenv(registry.ENVIRONMENT_VARIABLE, str(path))
    with pytest.raises(
        ValueError, match=f"^{path}: must be a readable TOML file in UTF-8, got .*must be a regular file"
    ):
        names()


def test_a_file_that_is_too_large_is_refused(fresh, tmp_path):
    with (tmp_path / "large.toml").open("wb") as file:
        file.truncate(10**12)  # sparse
    with pytest.raises(ValueError, match="large.toml: must be a readable TOML file in UTF-8, .*at most 10000000 bytes"):
        fresh.register(tmp_path / "large.toml")


def test_packages_offer_paths_or_materials(fresh, written, monkeypatch):
    offers = [EntryPoint(written(FILE)), EntryPoint([Material("gum", Medium(1.0, 0.1))])]
    monkeypatch.setattr(registry, "entry_points", lambda group: offers if group == "halfspace_sss.materials" else [])
    assert {"soap", "wax", "gum"} <= set(names())


@pytest.mark.parametrize("offered", [3, [3], ImportError("broken")], ids=["number", "list", "broken"])
def test_a_wrong_entry_point_is_left_out_by_name(fresh, monkeypatch, offered):
    monkeypatch.setattr(registry, "entry_points", lambda group: [EntryPoint(offered)])
    with pytest.warns(UserWarning, match="^entry point 'plugin' is left out: ") as found:
        assert len(names()) == 48
    assert len(found) == 1 and found[0].filename == "halfspace_sss.materials"


def test_a_package_cannot_replace_a_material(fresh, monkeypatch):
    offers = [EntryPoint([Material("gum", Medium(1.0, 0.1)), Material("Marble", Medium(1.0, 0.1))])]
    monkeypatch.setattr(registry, "entry_points", lambda group: offers)
    with pytest.warns(UserWarning, match="key name must be new, got 'Marble', which is 'marble' of"):
        assert load("marble").set == "Jensen2001" and "gum" not in names()
