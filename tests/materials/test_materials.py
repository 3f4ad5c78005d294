"""The material registry: look-up, dilution, files and plugins; what is wrong is refused by name."""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from registered import FILE

import halfspace_sss
from halfspace_sss import Medium
from halfspace_sss.materials import Material, files, load, names, table
from halfspace_sss.materials import catalogue as registry


def test_there_are_two_published_sets_and_the_medium_of_fig_10(fresh):
    counts = table().drop_duplicates("material")["set"].value_counts().to_dict()
    assert counts == {"Jensen2001": 12, "Narasimhan2006": 35, "NeuralSSS2024": 1}
    assert names() == sorted(names()) and len(names()) == 48


@pytest.mark.parametrize("spelling", ["Regular_Chocolate-Milk", "REGULAR chocolate  milk", "regularchocolatemilk"])
def test_case_and_separators_do_not_count(spelling):
    assert load(spelling) is load("regular chocolate milk")


def test_ampersand_and_the_word_are_the_same():
    assert load("Head and Shoulders shampoo") is load("head & shoulders shampoo")


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(ValueError, match="got 'marbel'; did you mean 'marble'"):
        load("marbel")


def test_a_name_like_nothing_points_to_the_list():
    with pytest.raises(ValueError, match=r"got 'xyzzy'; `halfspace-sss materials list` lists them"):
        load("xyzzy")


def test_another_g_keeps_the_reduced_scattering():
    plain, forward = load("marble").medium, load("marble", g=0.9).medium
    np.testing.assert_allclose(forward.sigma_s_prime, plain.sigma_s_prime, rtol=1e-14)
    np.testing.assert_allclose(forward.sigma_s, 10 * plain.sigma_s, rtol=1e-14)
    assert (forward.g == 0.9).all() and np.array_equal(forward.sigma_a, plain.sigma_a)
    assert "g = 0.9 asked for" in load("marble", g=0.9).assumptions


def test_a_measured_g_cannot_be_replaced():
    with pytest.raises(ValueError, match="g must be left out for 'coke', whose g is"):
        load("coke", g=0.5)


@pytest.mark.parametrize("g", [1.0, -1.0, float("nan")])
def test_a_g_out_of_range_is_refused(g):
    with pytest.raises(ValueError, match=r"g must be in the open interval \(-1, 1\), got"):
        load("marble", g=g)


def test_a_g_for_another_number_of_channels_is_refused():
    with pytest.raises(ValueError, match="g must be a number or have one value for each of"):
        load("marble", g=[0.1, 0.2])


@pytest.mark.parametrize("dilution", [0, -0.1, 1.1, float("nan"), float("inf"), "half", True])
def test_a_dilution_out_of_range_is_refused(dilution):
    with pytest.raises(ValueError, match=re.escape(f"dilution must be a volume fraction in (0, 1], got {dilution!r}")):
        load("regular milk", dilution=dilution)


def test_a_solid_cannot_be_diluted():
    with pytest.raises(ValueError, match="dilution must be left out for 'marble'"):
        load("marble", dilution=0.5)


def test_diluting_twice_multiplies():
    twice = load("regular milk", dilution=0.5).diluted(0.1)
    assert twice.dilution == 0.05
    np.testing.assert_allclose(twice.medium.sigma_s, load("regular milk", dilution=0.05).medium.sigma_s, rtol=1e-14)


def test_the_table_holds_what_load_gives(fresh):
    row = table().set_index(["material", "channel"]).loc[("regular chocolate milk", "G")]
    medium = load("regular chocolate milk").medium.channel(1)
    for column in ("sigma_s", "sigma_a", "sigma_t", "g", "eta", "albedo", "sigma_s_prime", "albedo_prime"):
        assert row[column] == getattr(medium, column)
    assert len(table()) == 3 * 47 + 1


def test_a_file_is_read_in_its_unit(fresh, written):
    assert fresh.register(written(FILE)) == ("soap", "wax")
    np.testing.assert_allclose(load("soap").medium.sigma_s_prime, [1.3, 1.4, 1.6], rtol=1e-15)
    np.testing.assert_allclose(load("wax").medium.sigma_s, [1.0, 1.0, 1.0], rtol=1e-15)
    assert load("wax").medium.g.tolist() == [0.5, 0.0, -0.5] and load("soap").medium.eta == 1.4
    assert load("soap").g_assumed and not load("wax").g_assumed


WRONG = {
    "path as a name": ('"wax"', '"../../wax"', "material '../../wax': name must be without '/', as folders are"),
    "long name": ('"wax"', '"' + 300 * "w" + '"', "name must have at most 80 bytes, got 300"),
    "unknown key": ("eta = 1.4", "eta = 1.4\nsorce = 'x'", "key sorce is unknown; did you mean 'source'?"),
    "unknown key of a material": ("g = [", "gg = [", "material 'wax', key gg is unknown; did you mean 'g'?"),
    "missing key": ('source = "own measurement"', "", "key source is required, got nothing"),
    "unit": ('"1/cm"', '"1/m"', "key unit: input should be '1/mm' or '1/cm', got '1/m'"),
    "negative": (
        "[0.1, 0.2, 0.4]\n\n",
        "[0.1, -0.2, 0.4]\n\n",
        "material 'soap', key sigma_a[1]: input should be greater",
    ),
    "not finite": ("13.0", "inf", "material 'soap', key sigma_s_prime[0]: input should be a finite number, got inf"),
    "g": ("-0.5", "-1.0", "material 'wax', key g[2]: input should be greater than -1, got -1.0"),
    "clear gel": ("-0.5", "1.0", "got 1.0; with g = 1 nothing is scattered: a clear layer is sigma_s = 1e-9, g = 0"),
    "eta": ("eta = 1.4", "eta = 0.0", "key eta: input should be greater than 0, got 0.0"),
    "no eta": ("eta = 1.4", "", "material 'soap': key eta is required"),
    "text": ("13.0", '"13"', "material 'soap', key sigma_s_prime[0]: input should be a valid number, got '13'"),
    "boolean": ("eta = 1.4", "eta = true", "key eta: input should be a valid number, got True"),
    "channels": ("g = [0.5, 0.0, -0.5]", "g = [0.5, 0.0]", "key g must have one value for each of ['R', 'G', 'B']"),
    "no channels": ('channels = ["R", "G", "B"]', "", "key sigma_s_prime must be one number"),
    "two ways": ("sigma_s = 10.0", "sigma_s = 1.0\nsigma_t = 2.0", "got sigma_s and sigma_t and sigma_a"),
    "no g": ("g = [0.5, 0.0, -0.5]", "", "material 'wax': key g is required with sigma_s"),
    "empty medium": (
        "= 10.0\nsigma_a = [0.1",
        "= 0.0\nsigma_a = [0.0",
        "sigma_t = sigma_s + sigma_a must be in [1e-18, 1e+18] (1/mm), got 0.0",
    ),
    "sample without tank": ("g = [", "sample_ml = 5.0\ng = [", "key sample_ml must be at most tank_ml (None), got 5.0"),
    "source of nothing": (
        '[[material]]\nname = "soap"',
        "[sources]\nsigmaa = 'x'\n[[material]]\nname = \"soap\"",
        "sigmaa",
    ),
    "name": ('"wax"', '"Soap "', "key name must be new, got 'Soap', which is 'soap' of"),
    "name of the library": ('"wax"', '"Marble"', "key name must be new, got 'Marble', which is 'marble' of"),
    "no TOML": ("[[material]]", "[[material", "must be TOML"),
}


@pytest.mark.parametrize("old, new, message", WRONG.values(), ids=WRONG)
def test_a_wrong_file_is_refused_by_file_key_bound_and_value(fresh, written, old, new, message):
    assert old in FILE
    with pytest.raises(ValueError) as error:
        fresh.register(written(FILE.replace(old, new, 1)))
    assert "mine.toml: " in str(error.value) and message in str(error.value)
    assert len(names()) == 48  # not even the right ones of that file


def test_a_folder_with_one_wrong_file_adds_nothing(fresh, written, tmp_path):
    written(FILE, "folder/a.toml")
    written(FILE.replace("soap", "tar").replace("wax", "pitch").replace("1/cm", "1/m"), "folder/b.toml")
    with pytest.raises(ValueError, match="b.toml: key unit"):
        fresh.register(tmp_path / "folder")
    assert len(names()) == 48


@pytest.mark.parametrize("path", ["missing.toml", "."])
def test_a_path_without_materials_is_refused(fresh, tmp_path, path):
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / path))):
        fresh.register(tmp_path / path)


def test_a_file_that_is_not_text_is_refused(fresh, tmp_path):
    (tmp_path / "damaged.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="damaged.toml: must be a readable TOML file"):
        fresh.register(tmp_path / "damaged.toml")


def test_only_a_material_or_a_path_can_be_registered(fresh):
    with pytest.raises(ValueError, match="material_or_path must be a Material or a path, got 3"):
        fresh.register(3)


def test_folders_of_the_environment_variable_and_of_the_user_are_read(fresh, written, monkeypatch, tmp_path):
    written(FILE, "one/a.toml")
    written(FILE.replace("soap", "tar").replace("wax", "pitch"), "config/halfspace-sss/materials/b.toml")
    single = written(FILE.replace("soap", "gum").replace("wax", "resin"), "c.toml")
    monkeypatch.setenv(registry.ENVIRONMENT_VARIABLE, os.pathsep.join([str(tmp_path / "one"), str(single)]))
    assert {"soap", "wax", "tar", "pitch", "gum", "resin"} <= set(names()) and len(names()) == 54


def test_a_missing_folder_of_the_environment_variable_is_refused(fresh, monkeypatch):
    monkeypatch.setenv(registry.ENVIRONMENT_VARIABLE, "/no/such/folder")
    with pytest.raises(ValueError, match="HALFSPACE_SSS_MATERIALS must list existing .* got '/no/such/folder'"):
        names()


WRONG_FIELDS = {
    "name": ({"name": " "}, "name must be a text that is not empty, got ' '"),
    "path": ({"name": "../../x"}, "name must be without '/', as folders are called by it, got '../../x'"),
    "path of Windows": ({"name": "a\\b"}, "name must be without '\\\\', as folders"),
    "drive": ({"name": "c:marble"}, "name must be without ':', as folders"),
    "hidden": ({"name": ".marble"}, "name must neither begin nor end with a dot or a space, got '.marble'"),
    "control character": ({"name": "mar\nble"}, "name must be without '\\n', as folders"),
    "length": ({"name": "m" * 300}, "name must have at most 80 bytes, got 300: 'mmmmm"),
    "punctuation": ({"name": "--"}, "name must contain a letter or a digit, got '--'"),
    "medium": ({"medium": 1.0}, "medium must be a Medium, got float"),
    "channels": ({"channels": ("R", "G", "B")}, "channels must match the None of medium"),
    "dilution": ({"published_dilution": 2.0}, "published_dilution must be a volume fraction in (0, 1], got 2.0"),
}


@pytest.mark.parametrize("change, message", WRONG_FIELDS.values(), ids=WRONG_FIELDS)
def test_a_wrong_field_of_a_material_is_refused(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Material(**{"name": "stone", "medium": Medium(1.0, 0.1), **change})


def test_a_material_cannot_be_changed_by_who_loads_it():
    with pytest.raises(TypeError):
        load("marble").sources["g"] = "changed"
    with pytest.raises(ValueError):
        load("marble").medium.sigma_a[0] = 1.0


def test_a_material_survives_pickling():
    assert pickle.loads(pickle.dumps(load("marble"))) == load("marble")


def test_a_material_makes_the_models_it_lists():
    marble = load("marble")
    assert set(marble.models()) <= set(halfspace_sss.models()) and "directional_dipole" in marble.models()
    model = marble.bssrdf("directional_dipole")
    assert model.name == "directional_dipole" and model.medium is marble.medium


def test_a_model_that_refuses_the_medium_is_not_listed():
    assert "forward_scattering_dipole" in load("marble").models()
    assert "forward_scattering_dipole" not in load("marble", g=-0.5).models()


def test_importing_the_registry_is_light():
    heavy = "torch mitsuba drjit matplotlib pandas pydantic scipy"
    code = f"import sys, halfspace_sss.materials; print([m for m in '{heavy}'.split() if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_written_materials_are_read_as_equal_ones(tmp_path: Path) -> None:
    for name in names():
        material = load(name)
        registry.write(tmp_path / "one.toml", material)
        assert files.read(tmp_path / "one.toml") == [material], name
    pair = [replace(material, name=f"{material.name} {k}", note='a "note" \\ of two') for k in range(2)]
    registry.write(tmp_path / "two.toml", *pair)
    assert files.read(tmp_path / "two.toml") == pair


@pytest.mark.parametrize(
    ("path", "change", "message"),
    [
        ("a.json", {}, r"path must end in .toml, got '.*a.json'"),
        ("a.toml", {"dilution": 0.5}, "dilution of 'b' must be 1 in a file, got 0.5"),
        ("a.toml", {"set": "other"}, "set of 'b' must be that of 'marble', 'Jensen2001', got 'other'"),
    ],
)
def test_materials_that_no_file_holds_are_not_written(tmp_path: Path, path: str, change: dict, message: str) -> None:
    marble = load("marble")
    with pytest.raises(ValueError, match=message):
        registry.write(tmp_path / path, marble, replace(marble, name="b", **change))
    assert not list(tmp_path.iterdir())
