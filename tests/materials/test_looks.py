"""Looks of other standards: what each defines, exactly; files of MaterialX and glTF."""

from __future__ import annotations

import math
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from figures.app import app
from halfspace_sss import Medium, trace
from halfspace_sss.backend import BackendError
from halfspace_sss.materials.files import read
from halfspace_sss.materials.imports import import_materials
from halfspace_sss.physics.fresnel import F_r

# published examples of OpenPBR (examples/open_pbr_*.mtlx): colour, radius scale, index
OPENPBR = {
    "skin I": ((0.762, 0.652, 0.568), (0.482, 0.169, 0.109), 1.4),
    "skin III": ((0.623, 0.433, 0.343), (0.482, 0.169, 0.109), 1.4),
    "skin VI": ((0.090, 0.050, 0.020), (0.367, 0.137, 0.068), 1.4),
    "ketchup": ((0.164, 0.006, 0.002), (0.476, 0.058, 0.039), 1.3),
    "marble": ((0.830, 0.791, 0.753), (0.851, 0.557, 0.395), 1.5),
    "pearl": ((0.8, 0.75, 0.7), (0.3, 0.5, 0.3), 1.5),
}


def van_de_hulst(color: np.ndarray, g: float) -> np.ndarray:
    """The albedo that OpenPBR 1.1 shows for a matched boundary."""
    s = 4.09712 + 4.20863 * color - np.sqrt(9.59217 + 41.6808 * color + 17.7126 * color**2)
    return (1 - s * s) / (1 - g * s * s)


@pytest.mark.parametrize("example", OPENPBR)
@pytest.mark.parametrize("g", [0.0, 0.8])
def test_openpbr_under_even_light_has_the_colour_asked_for(example: str, g: float) -> None:
    color, scale, eta = OPENPBR[example]
    medium = Medium.from_openpbr(color, 1.0, scale, g, eta)
    seen = medium.reflectance(1.0) / (1 - F_r(1.0, eta))  # along the normal, of what enters
    np.testing.assert_allclose(seen, color, rtol=1e-4)
    np.testing.assert_allclose(medium.mfp, scale, rtol=1e-12)


@pytest.mark.parametrize("example", OPENPBR)
def test_walks_in_openpbr_bring_out_the_colour_within_a_percent(example: str) -> None:
    """By reciprocity what is seen along the normal under even light is what a normal beam brings out."""
    color, scale, eta = OPENPBR[example]
    medium = Medium.from_openpbr(color, 1.0, scale, 0.0, eta)
    n_paths = 400_000 if color[0] > 0.3 else 1_600_000
    R = trace(medium.channel(0), 1.0, n_paths, 5).reflectance()
    wanted = color[0] * (1 - F_r(1.0, eta))
    assert R.standard_error < 0.0025 * wanted and abs(R.value - wanted) < 4 * R.standard_error


@pytest.mark.parametrize("example", OPENPBR)
def test_the_fit_of_a_matched_boundary_is_seen_much_darker(example: str) -> None:
    """By 12 to 75 % of the colour: it is made for no boundary, where it is right under diffuse light."""
    color, scale, eta = (np.array(v) for v in OPENPBR[example])
    fitted = Medium.from_albedo(van_de_hulst(color, 0.0), 1 / scale, 0.0, eta)
    missing = 1 - fitted.reflectance(1.0) / (1 - F_r(1.0, float(eta))) / color
    assert np.all(missing > 0.12) and np.all(missing < 0.8)
    matched = Medium.from_albedo(van_de_hulst(color, 0.0), 1 / scale, 0.0, 1.0)
    np.testing.assert_allclose(matched.reflectance(), color, atol=3e-3)  # of the fit itself


@pytest.mark.parametrize("g", [-0.8, 0.0, 0.9])
def test_white_openpbr_absorbs_nothing(g: float) -> None:
    medium = Medium.from_openpbr([1.0, 1.0, 1.0], subsurface_scatter_anisotropy=g)
    assert np.all(medium.albedo == 1)


def test_principled_has_the_radius_of_cycles_and_the_colour_of_openpbr() -> None:
    medium = Medium.from_principled([0.8, 0.5, 0.2], [1.0, 0.2, 0.1], 0.05, 0.5, 1.4)
    np.testing.assert_allclose(medium.mfp, np.array([50.0, 10.0, 5.0]) * 0.5 / (4 * math.pi), rtol=1e-12)
    np.testing.assert_allclose(medium.reflectance(1.0) / (1 - F_r(1.0, 1.4)), [0.8, 0.5, 0.2], rtol=1e-4)


def test_gltf_has_the_coefficients_of_its_extensions() -> None:
    """The example of KHR_materials_volume_scatter."""
    medium = Medium.from_gltf([0.572, 0.227, 0.075], 0.01, [0.9, 0.9, 0.9], 0.3)
    np.testing.assert_allclose(medium.sigma_t, -math.log(0.9) / 10, rtol=1e-12)
    np.testing.assert_allclose(medium.albedo, van_de_hulst(np.array([0.572, 0.227, 0.075]), 0.0), rtol=1e-12)
    assert np.all(medium.g == 0.3) and medium.eta == 1.5


@pytest.mark.parametrize("color", [0.02, 0.3, 0.7, 0.99])
def test_the_multiscatter_colour_of_gltf_is_the_matched_reflectance_under_diffuse_light(color: float) -> None:
    assert Medium.from_gltf(color, 0.01, 0.9, 0.0, 1.0).reflectance() == pytest.approx(color, abs=0.01)


BAD = [
    (lambda: Medium.from_openpbr([1.2, 0.5, 0.5]), r"subsurface_color must be in \[0, 1\], got 1.2"),
    (lambda: Medium.from_openpbr([0.5, 0.5]), "subsurface_radius_scale.* must have the same number of channels"),
    (lambda: Medium.from_openpbr([0.5] * 3, 0.0), "mfp must be finite and > 0"),
    (lambda: Medium.from_openpbr([0.5] * 3, specular_ior=[1.4, 1.5]), "specular_ior must be one number"),
    (lambda: Medium.from_openpbr([0.5] * 3, specular_ior=math.nan), r"specular_ior must be in \[0.01, 100\]"),
    (lambda: Medium.from_principled([0.5] * 3, subsurface_anisotropy=1.0), "subsurface_anisotropy must be in"),
    (lambda: Medium.from_gltf([0.5] * 3, math.inf, [0.9] * 3), "attenuation_distance must be finite and > 0"),
    (lambda: Medium.from_gltf([0.5] * 3, 0.1, [1.0] * 3), r"attenuation_color must be in the open interval \(0, 1\)"),
    (lambda: Medium.from_gltf([-0.5] * 3, 0.1, [0.9] * 3), r"multiscatter_color must be in \[0, 1\]"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_looks_that_no_medium_has_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


MTLX = """<?xml version="1.0"?>
<materialx version="1.39" colorspace="{space}">
  <surfacematerial name="Skin" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="shader" />
  </surfacematerial>
  <open_pbr_surface name="shader" type="surfaceshader">
    <input name="specular_ior" type="float" value="1.40" />
    <input name="subsurface_weight" type="float" value="{weight}" />
    <input name="subsurface_color" type="color3" {color} />
    <input name="subsurface_radius_scale" type="color3" value="0.482, 0.169, 0.109" />
    {more}
  </open_pbr_surface>
</materialx>
"""
COLOR = 'value="0.623, 0.433, 0.343"'


SMOOTH = '<input name="specular_roughness" type="float" value="0" />'
THIN = '<input name="geometry_thin_walled" type="boolean" value="true" />'


def mtlx(folder: Path, space: str = "lin_rec709", weight: float = 1.0, color: str = COLOR, more: str = SMOOTH) -> Path:
    path = folder / "skin.mtlx"
    path.write_text(MTLX.format(space=space, weight=weight, color=color, more=more))
    return path


def test_materialx_comes_in_with_name_and_medium(tmp_path: Path) -> None:
    pytest.importorskip("MaterialX")
    (found,) = import_materials(mtlx(tmp_path), mm_per_unit=2.0)
    assert found.name == "Skin" and found.channels == ("R", "G", "B")
    wanted = Medium.from_openpbr([0.623, 0.433, 0.343], 1.0, [0.482, 0.169, 0.109], 0.0, 1.4, 2.0)
    np.testing.assert_allclose(found.medium.albedo, wanted.albedo, rtol=1e-6)
    np.testing.assert_allclose(found.medium.mfp, wanted.mfp, rtol=1e-6)


def test_colours_in_acescg_become_rec_709(tmp_path: Path) -> None:
    pytest.importorskip("MaterialX")
    (found,) = import_materials(mtlx(tmp_path, "acescg", color='value="0.5, 0.5, 0.5"'))
    seen = found.medium.reflectance(1.0) / (1 - F_r(1.0, 1.4))
    np.testing.assert_allclose(seen, 0.5, rtol=1e-4)  # a grey stays grey
    assert found.medium.mfp[0] > 0.482  # a red of AP1 is more than the red of Rec. 709


FILES = [
    ({"weight": 0.0}, "must hold a material with subsurface scattering, got none"),
    ({"space": "srgb_displayp3"}, "material 'Skin': colour space of subsurface_color must be one of"),
    ({"color": 'nodename="texture"'}, "subsurface_color must be a value, got a connection"),
    ({"color": 'value="1.5, 0.4, 0.3"'}, r"subsurface_color must be in \[0, 1\]"),
    ({"color": "<"}, "must be a MaterialX document"),
    ({"more": THIN}, "material 'Skin': geometry_thin_walled must be false, got true: a thin wall has no inside"),
    ({"more": '<input name="base_metalness" type="float" value="1" />'}, "must hold a material with subsurface scat"),
]


def number(name: str, value: object, kind: str = "float") -> str:
    return f'<input name="{name}" type="{kind}" value="{value}" />'


NOT_TAKEN = [  # inputs of a surface, and what the warning says is not taken
    ("", 1.0, "specular_roughness = 0.3"),
    (
        SMOOTH + number("coat_weight", 0.5) + number("coat_roughness", 0.2), 1.0,
        "coat_weight = 0.5, coat_roughness = 0.2",
    ),
    (
        SMOOTH + number("base_color", "0.5, 0.25, 0", "color3") + number("base_weight", 0.5), 0.75,
        "subsurface_weight = 0.75, base_color = (0.5, 0.25, 0.0), base_weight = 0.5",
    ),
    (number("transmission_weight", 0.5), 1.0, "transmission_weight = 0.5, specular_roughness = 0.3"),
    (SMOOTH + '<input name="geometry_normal" type="vector3" nodename="m" />', 1.0, "geometry_normal = a connection"),
]  # fmt: skip


@pytest.mark.parametrize(("more", "weight", "told"), NOT_TAKEN)
def test_one_warning_lists_what_an_import_leaves_out(more: str, weight: float, told: str, tmp_path: Path) -> None:
    pytest.importorskip("MaterialX")
    with pytest.warns(UserWarning) as warned:
        (found,) = import_materials(mtlx(tmp_path, weight=weight, more=more))
    (message,) = [str(w.message) for w in warned]
    assert message.endswith(f"skin.mtlx: material 'Skin': its medium alone is imported, without {told}")
    assert found.name == "Skin"


def test_an_import_that_leaves_nothing_out_does_not_warn(tmp_path: Path) -> None:
    """Colour and roughness of layers without weight, and of a base that is all subsurface, change nothing."""
    pytest.importorskip("MaterialX")
    unseen = number("base_color", "0.5, 0.25, 0", "color3") + number("coat_roughness", 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        import_materials(mtlx(tmp_path, more=SMOOTH + unseen))


@pytest.mark.parametrize(("changes", "message"), FILES)
def test_materialx_that_holds_no_medium_is_refused(changes: dict, message: str, tmp_path: Path) -> None:
    pytest.importorskip("MaterialX")
    with pytest.raises(ValueError, match=f"skin.mtlx.*{message}"):
        import_materials(mtlx(tmp_path, **changes))


def glb(folder: Path, thickness: float = 0.1, metallic: float = 0.0, **more: dict) -> Path:
    pygltflib = pytest.importorskip("pygltflib")
    extensions = {
        "KHR_materials_volume_scatter": {"multiscatterColor": [0.572, 0.227, 0.075], "scatterAnisotropy": 0.3},
        "KHR_materials_volume": {"attenuationColor": [0.9, 0.8, 0.7], "attenuationDistance": 0.01},
        "KHR_materials_ior": {"ior": 1.4},
        **more,
    }
    extensions["KHR_materials_volume"]["thicknessFactor"] = thickness
    surface = pygltflib.PbrMetallicRoughness(metallicFactor=metallic, roughnessFactor=0.0)
    wax = pygltflib.Material(name="wax", extensions=extensions, pbrMetallicRoughness=surface)
    model = pygltflib.GLTF2(materials=[wax, pygltflib.Material()])
    model.save(str(folder / "wax.glb"))
    return folder / "wax.glb"


def test_gltf_comes_in_with_name_and_medium_and_leaves_other_materials_out(tmp_path: Path) -> None:
    (found,) = import_materials(glb(tmp_path))
    assert found.name == "wax"
    assert found.medium == Medium.from_gltf([0.572, 0.227, 0.075], 0.01, [0.9, 0.8, 0.7], 0.3, 1.4)


def test_gltf_warns_once_of_what_it_leaves_out_and_refuses_thin_walls(tmp_path: Path) -> None:
    sheen = {"KHR_materials_sheen": {"sheenRoughnessFactor": 0.5}}
    with pytest.warns(UserWarning) as warned:
        import_materials(glb(tmp_path, metallic=0.5, **sheen))
    (message,) = [str(w.message) for w in warned]
    wanted = "metallicFactor = 0.5, KHR_materials_sheen = {'sheenRoughnessFactor': 0.5}"
    assert message.endswith(f"wax.glb: material 'wax': its medium alone is imported, without {wanted}")
    with pytest.raises(
        ValueError, match="wax.glb: material 'wax': thicknessFactor must be > 0, got 0: a thin wall has"
    ):
        import_materials(glb(tmp_path, thickness=0.0))


def test_files_of_other_kinds_and_broken_ones_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="suffix of path must be one of .mtlx, .glb, .gltf, got '.blend'"):
        import_materials("skin.blend")
    with pytest.raises(ValueError, match="path must be a file, got 'none.glb'"):
        import_materials("none.glb")
    pytest.importorskip("pygltflib")
    broken = tmp_path / "broken.gltf"
    broken.write_text("{")
    with pytest.raises(ValueError, match="broken.gltf: must be a glTF file"):
        import_materials(broken)


@pytest.mark.parametrize(("suffix", "module"), [(".mtlx", "MaterialX"), (".glb", "pygltflib")])
def test_a_missing_package_is_named_with_its_extra(suffix: str, module: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"wax{suffix}").write_bytes(b"")
    with pytest.raises(BackendError, match=rf'{suffix} needs {module}: pip install "halfspace-sss\[import\]"'):
        import_materials(tmp_path / f"wax{suffix}")


def test_the_command_writes_a_material_file_that_the_registry_reads(tmp_path: Path) -> None:
    out = tmp_path / "wax.toml"
    result = CliRunner().invoke(app, ["materials", "import", str(glb(tmp_path)), "--out", str(out)])
    assert result.exit_code == 0 and "wax" in result.stdout
    (found,) = read(out)
    assert found.name == "wax" and found.medium == import_materials(glb(tmp_path))[0].medium


def test_the_command_refuses_to_import_nothing() -> None:
    result = CliRunner().invoke(app, ["materials", "import"])
    assert result.exit_code == 2 and "error: Missing argument 'file'" in result.stderr
