"""What people meet who are new to the library: names, messages, terminals, and what objects show of themselves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import halfspace_sss as sss
from figures import app as cli
from full_geometry.trade import recommend_flat
from halfspace_sss.provenance import read_text

MEDIUM = sss.Medium.from_albedo(0.75, 0.241)
QUICK = {"models": ["better_dipole"], "n_paths": 2000, "theta_i_deg": [0.0]}


def _run(*arguments: str, program: tuple[str, ...] = ("-m", "figures.command_line"), **environment: str):
    environment = {**os.environ, **environment}
    return subprocess.run([sys.executable, *program, *arguments], capture_output=True, env=environment, timeout=300)


def _refused(*arguments: str) -> str:
    found = CliRunner().invoke(cli.app, list(arguments))
    assert found.exit_code != 0
    return found.output + found.stderr


@pytest.fixture(scope="module")
def curve_set() -> sss.comparison.curve_set.CurveSet:
    return sss.curves(MEDIUM, **QUICK)


def test_the_package_runs_as_a_module() -> None:
    assert b"curves" in _run("--help").stdout


def test_a_terminal_without_unicode_shows_every_table() -> None:
    found = _run("trade", PYTHONIOENCODING="ascii", LC_ALL="C")
    assert found.returncode == 0, found.stderr
    assert b"path_traced" in found.stdout


def test_help_of_the_surface_works_before_it_is_registered() -> None:
    pytest.importorskip("mitsuba")
    code = "import full_geometry.surface.translucent as t; help(t)"
    assert b"The Mitsuba surface `translucent`" in _run(program=("-c", code)).stdout


def test_models_have_one_option_in_all_commands() -> None:
    for command in ("curves", "errors materials", "trade"):
        shown = CliRunner().invoke(cli.app, [*command.split(), "--help"]).output
        assert "--model" in shown


def test_a_model_of_objects_is_named_as_one_where_half_spaces_are_asked_for() -> None:
    with pytest.raises(ValueError, match="got 'neural_shape'.*`render` and .* take models of objects"):
        sss.curves(MEDIUM, models=["neural_shape"])


def test_a_grid_of_maps_is_refused_by_its_option() -> None:
    assert "grid 2,4,12,8: n_phi must be" in _refused("maps", "--grid", "2,4,12,8")


def test_an_unknown_material_is_refused_with_the_command_that_lists_them() -> None:
    with pytest.raises(ValueError, match="`halfspace-sss materials list` lists them"):
        sss.materials.load("nonsense")


def test_a_folder_of_weights_that_cannot_be_written_is_refused_with_the_variable(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", str(tmp_path / "file" / "weights"))
    with pytest.raises(ValueError, match="HALFSPACE_SSS_WEIGHTS names another folder"):
        sss.neural.train(MEDIUM)


def test_training_without_torch_says_what_to_install() -> None:
    code = "import sys; sys.modules['torch'] = None; import halfspace_sss; halfspace_sss.neural.train"
    assert b'train needs torch: pip install "halfspace-sss[train]"' in _run(program=("-c", code)).stderr


def test_errors_of_reflectance_are_those_of_the_series(curve_set) -> None:
    table = curve_set.errors().set_index("series")
    assert (table.loc["better_dipole", "reflectance_standard_error"] < 1e-4).all()
    assert (table["reflectance_traced_standard_error"] > 1e-4).all()


def test_objects_show_medium_and_unit_in_a_line(curve_set) -> None:
    advice = recommend_flat(MEDIUM, tolerance=0.5, events=1e5, models=["better_dipole"])
    trace = sss.trace(MEDIUM, 0.5, n_paths=1000)
    for found in (sss.bssrdf("neural", MEDIUM), trace, curve_set, advice):
        assert "\n" not in repr(found) and len(repr(found)) < 200
    for found in (sss.bssrdf("neural", MEDIUM), trace, curve_set):
        assert "sigma_t 0.241/mm, albedo 0.75, g 0, eta 1.3" in repr(found)
    marble = sss.materials.load("marble")
    for found in (MEDIUM, marble.medium, marble, curve_set, advice):
        assert "<table" in found._repr_html_()
    assert "marble, Jensen2001" in marble._repr_html_()


def test_curves_are_drawn_by_themselves(curve_set) -> None:
    figure = pytest.importorskip("matplotlib.figure")
    assert isinstance(curve_set.plot(), figure.Figure)
    assert '<img src="data:image/png;base64,iVBOR' in curve_set._repr_html_()


def test_both_integrators_warn_of_a_size_that_speaks_of_another_unit() -> None:
    mi = pytest.importorskip("mitsuba")
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    ball = {"type": "sphere", "bsdf": {"type": "translucent", "sigma_s": 1e4, "sigma_a": 1e4, "model": "lambert"}}
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    sensor = {"type": "perspective", "to_world": view, "film": film}
    for kind in ("bssrdf", "translucent_walk"):
        scene = mi.load_dict({"type": "scene", "integrator": {"type": kind}, "ball": ball, "sensor": sensor})
        with pytest.warns(UserWarning, match=r"6.93e\+04 to 6.93e\+04 mean free paths across"):
            mi.render(scene, spp=1)


@pytest.mark.parametrize("integrator", ["bssrdf", "translucent_walk"])
def test_a_mesh_without_faces_is_refused_in_a_sentence(integrator: str, tmp_path: Path) -> None:
    mi = pytest.importorskip("mitsuba")
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    (tmp_path / "empty.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 0\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    )
    surface = {"type": "translucent", "material": "marble"}
    mesh = {"type": "ply", "filename": str(tmp_path / "empty.ply"), "bsdf": surface}
    with pytest.raises(ValueError, match="a mesh must have faces, got none"):
        scene = mi.load_dict({"type": "scene", "integrator": {"type": integrator}, "mesh": mesh})
        mi.render(scene, spp=1)


@pytest.mark.parametrize("value", [1j, "1", np.array([1 + 0j]), ["a"], np.array("2026", "datetime64[Y]"), {}, 10**400])
@pytest.mark.parametrize("argument", ["r", "mu_i", "phi_o"])
def test_a_query_of_what_is_no_real_number_is_refused_by_name(argument: str, value: object) -> None:
    query = {"r": 1.0, "mu_i": 1.0, "phi_i": 0.0, "mu_o": 1.0, "phi_o": 0.0, argument: value}
    with pytest.raises(ValueError, match=f"^{argument} must be real numbers, got"):
        sss.bssrdf("better_dipole", MEDIUM).eval(**query)


@pytest.mark.parametrize("value", [1j, "1", {}, 10**400])
def test_so_it_is_beside_tensors(value: object) -> None:
    torch = pytest.importorskip("torch")
    model, value = sss.bssrdf("better_dipole", MEDIUM), torch.tensor(value) if isinstance(value, complex) else value
    with pytest.raises(ValueError, match="^mu_i must be real numbers, got"):
        model.eval(torch.ones(2), value, 0.0, 1.0, 0.0)


def test_a_model_is_named_by_a_text() -> None:
    with pytest.raises(ValueError, match=r"^model must be one of .*, got \[\]"):
        sss.bssrdf([], MEDIUM)


SPECTRA = "wavelength,mu_a,mu_s,g,n\n{},0.1,1,0.8,1.4\n{},0.2,2,0.8,1.4\n"


def test_the_mark_that_spreadsheets_put_first_is_no_part_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text(SPECTRA.format(450, 650), encoding="utf-8-sig")
    found = sss.materials.read_spectra(tmp_path / "skin.csv")
    assert found.wavelengths.tolist() == [450, 650]
    (tmp_path / "mine.toml").write_text("[mine]\nsigma_s = 1.0\nsigma_a = 0.1\n", encoding="utf-8-sig")
    assert "\ufeff" not in read_text(tmp_path / "mine.toml")


def test_wavelengths_in_micrometres_are_told(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text(SPECTRA.format(0.45, 0.65))
    with pytest.warns(UserWarning, match="wavelengths are in nm, got 0.45 to 0.65: of values in µm give 1000 times"):
        sss.materials.read_spectra(tmp_path / "skin.csv")


def test_layers_of_skin_are_those_of_one_wavelength() -> None:
    with pytest.raises(ValueError, match=r"wavelength must be one number \(nm\), .* got \[450, 550\]"):
        sss.materials.skin("II").layers([450, 550])


def test_a_store_without_a_name_is_refused() -> None:
    assert "name must have a letter at least" in _refused("maps", "--albedo", "0.5", "--name", "")


USES = (
    "from full_geometry.trade import recommend as f; f('ball.xml')",
    "from full_geometry.trade import assess as f; f('ball.xml')",
    "from full_geometry.inverse import fit as f; f('ball.xml', [])",
    "from full_geometry.scenes.reference import render as f; f('ball.xml', 'ball.exr')",
    "from full_geometry.scenes.scene_files import load_scene as f; f('ball.xml')",
    "from full_geometry import train as f; f('ball.xml')",
)


@pytest.mark.slow
def test_without_a_variant_of_mitsuba_a_scene_is_refused_with_what_to_do() -> None:
    pytest.importorskip("mitsuba")
    code = "\n".join(f"try:\n    {use}\nexcept ValueError as error:\n    print(error)" for use in USES)
    found = _run(program=("-c", code)).stdout.decode().splitlines()
    assert len(found) == len(USES)
    for line in found:
        assert line.startswith("a variant of Mitsuba must be set before a scene is looked at, got none: ")
        assert "mitsuba.set_variant('llvm_ad_rgb')" in line
