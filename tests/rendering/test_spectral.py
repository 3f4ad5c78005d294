"""Spectral variants: renders of the walk against mono renders, what media are, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_translucent_walk import WIDEST_Z_OF_RUNS, _runs, _scene, _z

from full_geometry.geometry.points import SurfacePoint, plane_query
from full_geometry.scenes.scene_files import open_scene
from halfspace_sss import Medium, bssrdf, materials

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

pytestmark = pytest.mark.usefixtures("spectral")

EVEN = {"type": "uniform", "value": 1.0}  # plain numbers of emitters are D65
SPECTRUM = {"type": "irregular", "wavelengths": "300, 500, 900", "values": "0.5, 0.9, 0.1"}
RUNS = 8
SHORT = {"type": "irregular", "wavelengths": "400, 700", "values": "1, 2"}


def _skin() -> materials.SpectralMedium:
    return materials.tissue(4.36, 0.41, 0.562, blood=0.02, baseline=True, water=0.65, g=lambda nm: 0.62 + 0.29e-3 * nm)


def _bands(wavelengths: np.ndarray) -> dict:
    """A film with a channel of 1 nm for each wavelength."""
    film = {"type": "specfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "component_format": "float32"}
    for nm in wavelengths:
        film[f"b{nm:04.0f}"] = {"type": "regular", "wavelength_min": nm - 0.5, "wavelength_max": nm + 0.5,
                                "values": "1, 1"}  # fmt: skip
    return film


def _lights() -> dict[str, dict]:
    return {
        "sky": {"type": "constant", "radiance": EVEN},
        "lamp": {"type": "sphere", "center": [20, 15, 20], "radius": 1.5, "bsdf": {"type": "diffuse"},
                 "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 300.0}}},
        "point": {"type": "point", "position": [20, 15, 20], "intensity": {"type": "uniform", "value": 3000.0}},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("integrator", "light", "n"),
    [
        pytest.param({"type": "translucent_walk", "mm_per_unit": 0.02}, "point", 4, marks=pytest.mark.slow),
        ({"type": "bssrdf", "mm_per_unit": 0.1, "model": "better_dipole"}, "lamp", 4),
        ({"type": "translucent_walk", "mm_per_unit": 0.02}, "sky", 9),
    ],
    ids=["walk, point", "better_dipole, lamp", "walk, sky"],
)
def test_each_wavelength_is_that_of_a_mono_render(integrator: dict, light: str, n: int) -> None:
    """Skin, with g by wavelength; the whole image, by runs of independent seeds."""
    skin, wavelengths = _skin(), np.linspace(400, 700, n)
    scene = _scene(skin.surface(), _lights()[light], **integrator)
    scene["sensor"]["film"] = _bands(wavelengths)
    loaded = mi.load_dict(scene)
    spectral = np.array([mi.render(loaded, spp=32 * n, seed=k) for k in range(RUNS)], dtype=float).mean(axis=(1, 2))
    mi.set_variant("llvm_ad_mono")
    z = []
    for k, nm in enumerate(wavelengths):
        m = skin.medium(float(nm))
        surface = {"sigma_s": m.sigma_s, "sigma_a": m.sigma_a, "g": m.g, "eta": skin.surface()["eta"]}
        mono = _runs(mi.load_dict(_scene(surface, _lights()[light], **integrator)), RUNS, 64, 100 * (k + 1))[..., 0]
        a, b = spectral[:, k], mono.mean(axis=(1, 2))
        z.append((a.mean() - b.mean()) / np.hypot(a.std(ddof=1), b.std(ddof=1)) * np.sqrt(RUNS))
    assert np.abs(z).max() < 4, z
    assert np.ptp(spectral.mean(axis=0)) > 0.2 * spectral.mean()  # wavelengths differ


@pytest.mark.parametrize(
    "model", ["better_dipole", "forward_scattering_dipole", pytest.param("neural", marks=pytest.mark.slow)]
)
def test_models_take_the_medium_at_each_wavelength(model: str) -> None:
    """To the error of nodes, and for networks that of similar media near the exit; sums of S over pairs of points."""
    skin, nm, unit = _skin(), [410.0, 530.0, 590.0, 690.0], 0.1
    scene = mi.load_dict(_scene({**skin.surface(), "model": model}, type="bssrdf", mm_per_unit=unit))
    obj = scene.integrator().prepare(scene)[0]
    rng, n = np.random.default_rng(3), 256
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wavelengths = mi.Spectrum(*nm)
    p, ends = rng.normal(size=(3, n)), []
    for x in (p, p + rng.normal(size=(3, n)) * rng.uniform(0.01, 0.3, n)):
        x = x / np.linalg.norm(x, axis=0)
        w = dr.normalize(mi.Vector3f(x + 0.3 * rng.normal(size=(3, n))))
        ends.append(SurfacePoint(mi.Point3f(10 * x), mi.Normal3f(x), mi.Normal3f(x), w))
    S = np.array(obj.transport.S(ends[0]._replace(medium=obj.medium_at(si)), ends[1]))
    query = plane_query(ends[1], ends[0])
    for found, wavelength in zip(S, nm):
        m = skin.medium(wavelength)
        alone = bssrdf(model, Medium(m.sigma_s, m.sigma_a, m.g, obj.media[0].eta).scaled(unit))
        wanted = np.array(alone.eval(*query)) * (np.array(query[3]) > 0)
        assert np.abs(found - wanted).sum() < (0.1 if model == "neural" else 0.003) * wanted.sum()


def test_a_grey_medium_under_d65_is_grey() -> None:
    """The film turns spectra into sRGB, whose white is D65."""
    grey = {"sigma_s": 1.0, "sigma_a": 0.1, "eta": 1.3}
    images = _runs(mi.load_dict(_scene(grey)), 6, 512, 1)
    mi.set_variant("llvm_ad_mono")
    mono = np.repeat(_runs(mi.load_dict(_scene(grey)), 6, 128, 100)[..., :1], 3, axis=-1)
    assert np.abs(_z(images, mono)).max() < WIDEST_Z_OF_RUNS


def _inside(**parameters: Any) -> Any:
    return mi.load_dict({"type": "translucent", **parameters}).spec


def test_the_medium_of_a_ray_is_that_of_its_wavelengths() -> None:
    skin = _skin()
    inside, nm = _inside(**skin.surface()), [400.5, 523.3, 612.0, 830.0]
    found = np.array(inside.spectral.scaled(2.0).at(mi.Spectrum(*nm))).reshape(3, 4)
    m = skin.medium(nm)
    np.testing.assert_allclose(found, [2 * m.sigma_t, 2 * m.sigma_s, m.g], rtol=2e-4)


def test_files_and_spectra_of_mitsuba_are_the_same_medium(tmp_path: Path) -> None:
    path, nm = tmp_path / "mine.csv", np.array([300, 500, 900])
    albedo, sigma_t = np.array([0.5, 0.9, 0.1]), 2.0
    rows = zip(nm, 10 * sigma_t * (1 - albedo), 10 * sigma_t * albedo, [0.3] * 3, [1.4] * 3)
    path.write_text("wavelength,mu_a,mu_s,g,n\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows))
    a = _inside(spectra=str(path), unit="1/cm")
    text = (
        '<bsdf version="3.0.0" type="translucent"><spectrum name="albedo" value="300:0.5, 500:0.9, 900:0.1"/>{}</bsdf>'
    )
    more = "".join(f'<float name="{k}" value="{v}"/>' for k, v in (("sigma_t", 2.0), ("g", 0.3), ("eta", 1.4)))
    b = _inside(albedo=SPECTRUM, sigma_t=2.0, g=0.3, eta=1.4)
    for other in (b, mi.load_string(text.format(more)).spec):
        for x, y in zip(a.spectral.tables, other.spectral.tables):
            np.testing.assert_allclose(np.array(x), np.array(y), rtol=1e-5)
    assert a.medium.eta == b.medium.eta == 1.4


def test_a_painted_colour_is_a_spectrum() -> None:
    """Its half-space has the reflectance of Mitsuba's spectrum of the colour, which goes to 1 in the far red."""
    colour = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
    with pytest.warns(UserWarning, match="of 471 wavelengths of reflectance are above 0.9232"):
        inside = _inside(reflectance=colour, mfp=0.5, g=0.5, eta=1.4)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = mi.Spectrum(450, 540, 610, 690)
    wanted = np.ravel(np.array(mi.load_dict(colour).eval(si)))
    found = inside.spectral.spectra.reflectance([450, 540, 610, 690])
    np.testing.assert_allclose(found, wanted, rtol=2e-3)


@pytest.mark.parametrize(
    ("surface", "reason"),
    [
        ({"material": "marble"}, "material must be left out under a spectral variant.*got 'marble': give spectra"),
        ({"sigma_s": "1,2,3", "sigma_a": 1.0}, "sigma_s must be a number or a spectrum.*got '1,2,3'"),
        ({"sigma_s": {"type": "rgb", "value": [0.1, 0.2, 0.3]}, "sigma_a": 1.0}, "sigma_s must be a number or a spec"),
        ({"albedo": {"type": "checkerboard"}, "sigma_t": 1.0}, "albedo must be .* the same over all of the object"),
        ({"sigma_s": SHORT, "sigma_a": 1.0, "eta": SPECTRUM}, "eta must be a number.*dispersion is left out"),
        ({"albedo": SHORT, "sigma_t": 1.0}, r"albedo must be in \[0, 1\], got 1.003"),
        ({"spectra": "none.csv", "sigma_t": 1.0}, "spectra must stand without sigma_t"),
        ({"sigma_t": SHORT}, "a translucent surface must have spectra, or"),
    ],
)
def test_what_is_no_medium_by_wavelength_is_refused(surface: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{reason}"):
        mi.load_dict({"type": "translucent", **surface})


def test_spectra_that_do_not_cover_the_film_are_refused() -> None:
    scene = _scene({"sigma_s": SHORT, "sigma_a": 1.0})
    with pytest.raises(
        ValueError,
        match="^spectra of object 'object' must cover 360 to 830 nm, which the film sees, got .* 400 to 700 nm",
    ):
        mi.render(mi.load_dict(scene), spp=1)
    scene["sensor"]["film"] = _bands(np.array([450.0, 650.0]))
    assert np.isfinite(mi.render(mi.load_dict(scene), spp=1).numpy()).all()


def test_spectra_are_refused_under_other_variants(rgb: None) -> None:
    with pytest.raises(ValueError, match="^spectra must be left out but under a spectral variant, got 'a.csv'"):
        mi.load_dict({"type": "translucent", "spectra": "a.csv"})


def test_other_models_light_and_derivatives_refuse_spectra() -> None:
    scene = mi.load_dict(_scene({"sigma_s": SPECTRUM, "sigma_a": 1.0, "model": "better_dipole"}))
    for settings, reason in (
        (
            {"model": "neural_shape"},
            "variant must be RGB or mono for the model 'neural_shape' of object 'object', got",
        ),
        ({"model": "auto"}, "model must be named under a spectral variant, got 'auto'"),
        ({"light": "gathered"}, "light must be 'sampled' under a spectral variant, got 'gathered'"),
    ):
        with pytest.raises(ValueError, match=f"^{reason}"):
            mi.render(scene, integrator=mi.load_dict({"type": "bssrdf", **settings}), spp=1)
    with pytest.raises(ValueError, match="^derivatives must be of an RGB or mono variant, got llvm_ad_spectral"):
        scene.integrator().render_backward(scene, None, mi.TensorXf(0))


def test_a_bitmap_stays_as_it_is_when_its_scene_is_loaded() -> None:
    """Mitsuba writes the coefficients of spectra into the bitmap that it is given, and would take these for colours."""
    image = mi.Bitmap(np.linspace(0.1, 0.9, 12, dtype=np.float32).reshape(2, 2, 3))
    bytes_of = mi.Bitmap(np.full((2, 2, 3), 90, dtype=np.uint8))
    textures = {"a": {"type": "bitmap", "bitmap": image}, "b": {"type": "bitmap", "bitmap": bytes_of, "raw": True}}
    before = np.array(image)
    scenes = [{"type": "scene", key: {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}, "o": {
        "type": "sphere", "center": [3, 0, 0], "bsdf": {"type": "translucent", "albedo": 0.9, "sigma_t": 1.0}}}
        for key, texture in textures.items()]  # fmt: skip
    for scene in scenes:
        mi.load_dict(scene)
        open_scene(scene)
    assert np.array_equal(np.array(image), before) and bytes_of.srgb_gamma()
