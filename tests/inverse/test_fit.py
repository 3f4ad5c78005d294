"""The fit of media to images: what is refused, what is found, and that it goes on where it was left."""

from __future__ import annotations

import gc
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

from figures import app as cli  # noqa: E402
from full_geometry import inverse  # noqa: E402
from full_geometry.inverse.comparing import ChiSquare, ViewComparison  # noqa: E402
from full_geometry.inverse.views import GivenView, read_views  # noqa: E402
from full_geometry.scenes.scene_files import open_scene  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")

SAMPLED = '<string name="light" value="sampled"/>'
XML = f"""<scene version="3.0.0">
  <integrator type="translucent_walk"><boolean name="hide_emitters" value="true"/>{SAMPLED}</integrator>
  <emitter type="directional"><vector name="direction" x="-0.2" y="0.3" z="-1"/></emitter>
  <emitter type="constant"><float name="radiance" value="0.3"/></emitter>
  <sensor type="perspective">
    <float name="fov" value="14"/>
    <transform name="to_world"><lookat origin="0,0,40" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
  </sensor>
  <shape type="sphere" id="ball">
    <float name="radius" value="4"/>
    <bsdf type="translucent">
      <string name="albedo" value="0.9, 0.85, 0.68"/><string name="sigma_t" value="0.5"/><float name="eta" value="1"/>
    </bsdf>
  </shape>
</scene>
"""
TRUE = {"albedo": (0.95, 0.9, 0.6), "sigma_t": (0.5, 0.5, 0.5)}


def _scene(tmp_path: Path) -> mi.Scene:
    (tmp_path / "a.xml").write_text(XML)
    return open_scene(tmp_path / "a.xml")


def _put(scene: mi.Scene, values: dict) -> None:
    surface = scene.shapes()[0].bsdf()
    for name, value in values.items():
        setattr(surface, name, mi.Spectrum(np.ravel(value).tolist()))
    surface.parameters_changed(list(values))


def _target(scene: mi.Scene, spp: int = 4096) -> np.ndarray:
    before = {name: np.array(getattr(scene.shapes()[0].bsdf(), name)) for name in TRUE}
    _put(scene, TRUE)
    image = np.array(mi.render(scene, spp=spp, seed=99))
    _put(scene, before)
    return image


def test_views_and_parameters_that_do_not_fit_are_refused_by_name(tmp_path: Path) -> None:
    scene, image = _scene(tmp_path), np.full((8, 8, 3), 0.5, np.float32)
    good = GivenView.of("a", 0, image)

    def refused(match: str, images: Any = (good,), names: tuple[str, ...] = ("albedo",), **more: Any) -> None:
        with pytest.raises(ValueError, match=match):
            inverse.fit(scene, list(images), names, model=None, **more)

    refused("image a must be 8 x 8 of 3 channels as sensor 0, got 4 x 8", [GivenView.of("a", 0, image[:, :4])])
    refused("sensor of a must be below 1", [GivenView.of("a", 1, image)])
    refused("parameter must be one of albedo.*got 'albdo'; did you mean 'albedo'", names=("albdo",))
    refused("parameter must not be of a shape.*got 'ball.vertex_positions'", names=("ball.vertex_positions",))
    refused("alpha of 'ball' must be a number of a roughdielectric to be fitted, got a smooth", names=("alpha",))
    refused("edits of b must be of the keys none as of a", [good, GivenView.of("b", 0, image, edits={"x": [1]})])
    refused("lamp in edits of a must be the key of numbers", [GivenView.of("a", 0, image, edits={"lamp": [1]})])
    key = "ball.bsdf.albedo"
    refused(f"{key} in edits of a must be 3 finite numbers", [GivenView.of("a", 0, image, edits={key: [1]})])
    refused("sigma_t or mfp, got both", names=("mfp", "sigma_t"))
    refused("object must be one of ball", object="bell")
    refused("not held out, got none", [GivenView.of("a", 0, image, held_out=True)])
    with pytest.raises(ValueError, match="image a must be finite, got 1 pixels"):
        GivenView.of("a", 0, np.where(np.arange(192).reshape(8, 8, 3) == 7, np.nan, image))
    aside = XML.replace('target="0,0,0"', 'target="0,40,0"')
    (tmp_path / "b.xml").write_text(aside)
    there, scene = scene.sensors()[0], open_scene(tmp_path / "b.xml")
    views = [GivenView.of("b", there, image), GivenView.of("a", 0, image)]
    refused("fitted views must show object ball, got nothing of it in a", views)


@pytest.mark.parametrize("model", ["full_geometry", "lambert", "auto"])
def test_models_without_derivatives_are_refused_before_anything_is_rendered(tmp_path: Path, model: str) -> None:
    _scene(tmp_path)
    view = GivenView.of("a", 0, np.full((8, 8, 3), 0.5, np.float32))
    with pytest.raises(ValueError, match=f"model must have derivatives by the medium, got '{model}'"):
        inverse.fit(tmp_path / "a.xml", [view], ("albedo",), model)


def test_integrators_and_light_without_derivatives_are_refused(tmp_path: Path) -> None:
    view = GivenView.of("a", 0, np.full((8, 8, 3), 0.5, np.float32))
    gathered = '<string name="light" value="gathered"/><string name="model" value="better_dipole"/>'
    for integrator, match in (
        ('<integrator type="path">', "integrator must be translucent_walk or bssrdf, got PathIntegrator"),
        (f'<integrator type="bssrdf">{gathered}', "light must be sampled to fit a medium, got gathered"),
    ):
        scene = XML.replace(SAMPLED, "").replace('<integrator type="translucent_walk">', integrator)
        (tmp_path / "a.xml").write_text(scene)
        with pytest.raises(ValueError, match=match):
            inverse.fit(mi.load_file(str(tmp_path / "a.xml")), [view], ("albedo",))


def test_views_of_a_file_are_linear_and_leave_out_what_is_saturated(tmp_path: Path) -> None:
    shown = np.full((2, 2, 3), 128, np.uint8)
    shown[0, 0] = 255
    mi.Bitmap(shown).write(str(tmp_path / "a.png"))
    row = {"image": "a.png", "transfer": "srgb", "held_out": True}
    (tmp_path / "views.json").write_text(json.dumps({"views": [row]}))
    with pytest.warns(UserWarning, match="a.png: 1 saturated pixels do not count"):
        (view,) = read_views(tmp_path / "views.json")
    assert view.held_out and view.counts.tolist() == [[False, True], [True, True]]
    assert view.image[1, 1] == pytest.approx(0.2158605, abs=1e-5)
    for wrong, match in (({"image": "a.png"}, "must have a transfer"), ({**row, "senor": 0}, "did you mean 'sensor'")):
        (tmp_path / "views.json").write_text(json.dumps({"views": [wrong]}))
        with pytest.raises(ValueError, match=match):
            read_views(tmp_path / "views.json")


@pytest.mark.slow
def test_the_albedo_of_an_object_is_found_from_its_image(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    views = [GivenView.of("a", 0, _target(scene))]
    found = inverse.fit(scene, views, ("albedo",), settings=inverse.FitSettings(steps=32, spp=64))
    assert found.values["albedo"] == pytest.approx(TRUE["albedo"], abs=0.015)
    assert found.steps[-1].loss < found.steps[0].loss
    assert not found.told


def test_weights_do_not_know_the_noise_of_an_image(tmp_path: Path) -> None:
    """But that of its mean, to 3 %; weights by its pixels would differ by 20 %, and be smaller where it is bright."""
    scene = _scene(tmp_path)
    image = np.array(mi.render(scene, spp=256, seed=9))
    noise, weights = 0.1 * np.random.default_rng(0).standard_normal(image.shape), []
    for given in (image, image * (1 + noise)):
        comparison = ViewComparison(scene, [GivenView.of("a", 0, given)], inverse.FitSettings(spp=16))
        weights.append(comparison.view(0, 0).weights)
    ratio = weights[1] / weights[0]
    assert np.ptp(ratio) < 0.03 and abs(ratio.mean() - 1) < 0.03


@pytest.mark.slow
def test_errors_of_fits_to_noisy_images_are_those_that_are_stated(tmp_path: Path) -> None:
    """14 fits at 10 % of noise: no bias beyond half of the stated errors, and z of an rms of 1.

    The robust loss takes the weights of the relative one, and bends them.
    """
    scene, z = _scene(tmp_path), []
    image = _target(scene, 8192)
    for seed in range(14):
        noise = 1 + 0.1 * np.random.default_rng(100 + seed).standard_normal(image.shape)
        settings = inverse.FitSettings(steps=8, spp=32, loss="robust", seed=seed)
        found = inverse.fit(tmp_path / "a.xml", [GivenView.of("a", 0, image * noise)], ("albedo",), settings=settings)
        z.append((found.values["albedo"] - TRUE["albedo"]) / found.errors["albedo"])
        assert not found.is_misfit and "residuals: noise, chi-square" in found.lines()[-1]
    assert 0.8 < np.sqrt(np.square(z).mean()) < 1.2
    assert abs(np.mean(z)) < 0.5


@pytest.mark.slow
def test_albedo_and_extinction_are_found_together_from_one_noisy_view(tmp_path: Path) -> None:
    text = XML.replace('name="eta" value="1"', 'name="eta" value="1.4"').replace('value="8"', 'value="24"')
    (tmp_path / "a.xml").write_text(text)
    image = _target(open_scene(tmp_path / "a.xml"), 4096)
    image = image * (1 + 0.02 * np.random.default_rng(0).standard_normal(image.shape))
    settings = inverse.FitSettings(steps=10)
    found = inverse.fit(tmp_path / "a.xml", [GivenView.of("a", 0, image)], settings=settings)
    assert not found.is_misfit
    for name, true in TRUE.items():
        assert found.values[name] == pytest.approx(true, rel=0.08)
        assert np.abs((found.values[name] - true) / found.errors[name]).max() < 4


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.1, 0.5])
def test_a_misfit_of_brightness_is_told(tmp_path: Path, factor: float) -> None:
    """With --exposure too, which leaves the brightness of all images together as it is."""
    text = XML.replace('value="8"', 'value="16"')
    (tmp_path / "a.xml").write_text(text)
    image = factor * _target(open_scene(tmp_path / "a.xml"), 2048)
    image = image * (1 + 0.02 * np.random.default_rng(0).standard_normal(image.shape))
    settings = inverse.FitSettings(steps=12, spp=64, exposure=factor < 1)
    found = inverse.fit(tmp_path / "a.xml", [GivenView.of("a", 0, image)], ("albedo",), settings=settings)
    assert found.is_misfit and "residuals: misfit, chi-square" in found.lines()[-1]
    told = " ".join(found.told)
    low, high = (1.05, 1.3) if factor > 1 else (0.4, 0.8)
    assert low < float(re.search(r"all renders times ([\d.]+) ±", told).group(1)) < high


def test_a_chi_square_knows_noise_also_of_a_filter_from_a_misfit() -> None:
    rng = np.random.default_rng(0)
    values, near = [], []
    for _ in range(50):
        row, column = np.indices((24, 24)) - 11.5
        other, noise = rng.standard_normal((2, 24, 24, 3)) * rng.uniform(0.5, 2, (2, 24, 24, 1))
        other[np.hypot(row, column) > 9] = noise[np.hypot(row, column) > 9] = 0
        filtered = noise
        for axis in (0, 1):
            filtered = filtered + 0.15 * (np.roll(filtered, 1, axis) + np.roll(filtered, -1, axis))
        both = ChiSquare.of([noise, other]), ChiSquare.of([filtered])
        values.append([(each.value - 1) / each.error for each in both])
        near.append([each.near for each in both])
        smooth = 0.9 * np.where(np.hypot(row, column) > 6, -1, 1)[..., None] * (noise != 0)
        assert ChiSquare.of([noise + smooth]).is_misfit and not any(each.is_misfit for each in both)
    assert np.std(values, axis=0) == pytest.approx([1, 1.2], abs=0.3)
    assert np.mean(near, axis=0) == pytest.approx([1.05, (1.3**2 / 1.045) ** 2], rel=0.1)


@pytest.mark.slow
def test_a_robust_loss_leaves_out_spoiled_pixels_and_has_no_bias_by_noise(tmp_path: Path) -> None:
    clean = _target(_scene(tmp_path))
    spoiled = clean.copy()
    spoiled[np.random.default_rng(0).random((8, 8)) < 0.1] *= 3
    errors = {}
    for image, loss in ((clean, "robust"), (spoiled, "robust"), (spoiled, "relative")):
        settings = inverse.FitSettings(steps=16, spp=32, loss=loss)
        views = [GivenView.of("a", 0, image)]
        found = inverse.fit(tmp_path / "a.xml", views, ("albedo",), settings=settings).values["albedo"]
        errors[image is clean, loss] = np.abs(found - TRUE["albedo"]).max()
    assert errors[True, "robust"] < 0.015
    assert errors[False, "robust"] < 0.03
    assert errors[False, "relative"] > 2 * errors[False, "robust"]


def _fit_with_kernels(*arguments: Any, **how: Any) -> tuple[Any, list[set]]:
    """A fit, and the kernels of each of its steps."""
    kernels = []

    def keep(*_: Any) -> None:
        kernels.append({kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel})

    gc.collect()  # scenes of other tests would leave the registry between two steps, and change their kernels
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        return inverse.fit(*arguments, progress=keep, **how), kernels


def test_all_steps_of_a_fit_run_the_same_kernels(tmp_path: Path) -> None:
    """What is code in one step and another code in the next is compiled each time."""
    (tmp_path / "a.xml").write_text(XML.replace('name="eta" value="1"', 'name="eta" value="1.3"'))
    view, settings = GivenView.of("a", 0, np.full((8, 8, 3), 0.4, np.float32)), inverse.FitSettings(steps=3, spp=4)
    _, kernels = _fit_with_kernels(tmp_path / "a.xml", [view], ("albedo", "sigma_t"), settings=settings)
    assert kernels[2] and kernels[2] <= kernels[1]


def test_a_fit_does_not_go_on_in_another_light(tmp_path: Path) -> None:
    scene, view = tmp_path / "a.xml", GivenView.of("a", 0, np.full((8, 8, 3), 0.4, np.float32))
    how = {"settings": inverse.FitSettings(steps=1, spp=4), "work": tmp_path / "work"}
    scene.write_text(XML)
    first, again = (inverse.fit(scene, [view], ("albedo",), **how) for _ in range(2))
    assert (first.values["albedo"] == again.values["albedo"]).all()
    scene.write_text(XML.replace('name="radiance" value="0.3"', 'name="radiance" value="0.6"'))
    with pytest.raises(ValueError, match="work must be a new folder or come from the same fit"):
        inverse.fit(scene, [view], ("albedo",), **how)


@pytest.mark.slow
def test_a_killed_fit_goes_on_with_the_same_bits_and_the_command_writes_a_scene(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    image = _target(scene, 64)
    mi.Bitmap(image).write(str(tmp_path / "a.exr"))
    (tmp_path / "views.json").write_text(json.dumps({"views": [{"image": "a.exr"}]}))
    arguments = ["fit", str(tmp_path / "a.xml"), "--images", str(tmp_path / "views.json"), "--steps", "3", "--spp", "4"]
    whole = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path / "whole")])
    assert whole.exit_code == 0, whole.output

    def kill(done: int, *_: Any) -> None:
        if done == 2:
            raise KeyboardInterrupt

    how = {"settings": inverse.FitSettings(steps=3, spp=4), "work": tmp_path / "work"}
    with pytest.raises(KeyboardInterrupt):
        inverse.fit(tmp_path / "a.xml", read_views(tmp_path / "views.json"), progress=kill, **how)
    rest = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path / "rest"), "--work", str(tmp_path / "work")])
    assert rest.exit_code == 0, rest.output
    numbers = [json.loads((tmp_path / each / "a_fit.json").read_text()) for each in ("whole", "rest")]
    assert all(numbers[0][key] == numbers[1][key] for key in numbers[0] if key != "provenance")
    medium = open_scene(tmp_path / "rest" / "a_fit.xml").shapes()[0].bsdf().spec.medium
    assert medium.albedo == pytest.approx(numbers[0]["values"]["albedo"])
    assert "[[material]]" in (tmp_path / "rest" / "a_fit.toml").read_text()
    pages = [(tmp_path / each / "a_fit.html").read_text() for each in ("whole", "rest")]
    assert pages[0] == pages[1] and "albedo: " in pages[0] and '"found"' in pages[0] and '"given"' in pages[0]


@pytest.mark.slow
def test_exposures_of_images_are_found_and_noise_at_most_doubles_the_error(tmp_path: Path) -> None:
    start = XML.index("  <sensor")
    end = XML.index("  <shape")
    sensors = "".join(XML[start:end].replace("0,0,40", eye) for eye in ("0,0,40", "40,1,0"))
    (tmp_path / "a.xml").write_text(XML[:start] + sensors + XML[end:])
    scene = open_scene(tmp_path / "a.xml")
    _put(scene, TRUE)
    images = [np.array(mi.render(scene, sensor=k, spp=4096, seed=90 + k)) for k in range(2)]
    rng, factors = np.random.default_rng(0), np.array([1.05, 1 / 1.05])
    noisy = [e * image * (1 + 0.01 * rng.standard_normal(image.shape)) for e, image in zip(factors, images)]
    errors = {}
    for exposure, given in ((False, images), (True, noisy)):
        settings = inverse.FitSettings(steps=12, spp=128, exposure=exposure)
        views = [GivenView.of(f"view {k}", k, image) for k, image in enumerate(given)]
        found = inverse.fit(open_scene(tmp_path / "a.xml"), views, ("albedo",), model=None, settings=settings)
        errors[exposure] = np.sqrt(np.square(found.values["albedo"] - TRUE["albedo"]).mean())
    assert errors[True] < 2 * errors[False]
    assert found.exposures == pytest.approx(factors, abs=0.005)


@pytest.mark.slow
def test_a_model_of_the_half_space_is_fitted_to_its_own_image_by_the_same_kernels(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(XML.replace('name="eta" value="1"', 'name="eta" value="1.3"'))
    scene = open_scene(tmp_path / "a.xml", "better_dipole")
    views = [GivenView.of("a", 0, _target(scene, 1024))]
    settings = inverse.FitSettings(steps=5, spp=64)
    _put(scene, {"sigma_t": TRUE["sigma_t"]})
    found, kernels = _fit_with_kernels(scene, views, ("albedo",), model=None, settings=settings)
    assert found.values["albedo"] == pytest.approx(TRUE["albedo"], abs=0.02)
    assert kernels[2] and kernels[2] <= kernels[1]
