"""Scenes at the edge of what can be rendered: what is refused, what is warned of, what must stay finite."""

from __future__ import annotations

import subprocess
import sys
import warnings

import numpy as np
import pytest
from rendered import MEDIUM, direction, plane_scene, render, sun, surface

mi = pytest.importorskip("mitsuba")

START = [sys.executable, "-c", "from figures.command_line import main; main()"]
SPHERE = {"type": "sphere", "radius": 5.0}


@pytest.fixture(autouse=True)
def _variant():
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


def view(shape: dict, emitter: dict | None = None, distance: float = 30.0, n: int = 16, **settings) -> dict:
    """An object in the middle of a perspective image."""
    at = mi.ScalarTransform4f().look_at((distance * direction(20)).tolist(), [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": n, "height": n, "rfilter": {"type": "box"}}
    return {
        "type": "scene", "integrator": {"type": "bssrdf", "max_depth": 3, **settings},
        "light": emitter or {"type": "constant"}, "object": shape,
        "sensor": {"type": "perspective", "fov": 20.0, "to_world": at, "film": film},
    }  # fmt: skip


def test_paths_have_no_limit_unless_one_is_set() -> None:
    """Of a white ball in a glass case eight vertices lose light."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    white = {"type": "translucent", "sigma_t": 200.0, "albedo": 1.0, "eta": 1.3, "model": "lambert"}
    scene = {
        "type": "scene", "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "fov": 14, "to_world": view, "film": film},
        "case": {"type": "sphere", "radius": 1.5, "bsdf": {"type": "dielectric"}},
        "ball": {"type": "sphere", "bsdf": white},
    }  # fmt: skip
    depths = ({}, {"max_depth": -1}, {"max_depth": 8})
    unset, unlimited, eight = (render(scene | {"integrator": {"type": "bssrdf", **depth}}, 2**9) for depth in depths)
    assert (unset == unlimited).all() and unset.mean() > eight.mean() + 0.01


def quietly(scene: dict, spp: int = 4) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return render(scene, spp)


def refused(message: str, scene: dict) -> None:
    """Mitsuba wraps what an integrator raises while rendering; `load_scene` lets it through."""
    from full_geometry.scenes.scene_files import load_scene

    with pytest.raises((ValueError, RuntimeError), match=message), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        load_scene(scene)


def test_an_unknown_model_is_refused_with_the_nearest_name():
    refused("did you mean 'directional_dipole'", view({**SPHERE, "bsdf": surface("directional_dipol")}))


@pytest.mark.parametrize(
    ("plugin", "wrong", "meant"),
    [
        ({"type": "translucent", "material": "marble", "modle": "neural"}, "modle", "model"),
        ({"type": "translucent", "material": "marble", "reflektion": False}, "reflektion", "reflection"),
        ({"type": "translucent", "material": "marble", "shiny": {"type": "uniform", "value": 1.0}}, "shiny", None),
        ({"type": "bssrdf", "mm_per_unti": 10.0}, "mm_per_unti", "mm_per_unit"),
        ({"type": "translucent_walk", "max_dpth": 3}, "max_dpth", "max_depth"),
        ({"type": "translucent_walk", "area_share": 0.5}, "area_share", None),
    ],
)
def test_an_unknown_parameter_is_refused_by_name(plugin, wrong, meant):
    with pytest.raises(Exception) as error:
        mi.load_dict(plugin)
    assert f"parameter of {plugin['type']} must be one of" in str(error.value)
    assert f"got {wrong!r}" in str(error.value)
    assert meant is None or f"got {wrong!r}; did you mean {meant!r}?" in str(error.value)


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ({"priority": "1,2"}, "priority must be a number, got '1,2'"),
        ({"thickness": "thin"}, "thickness must be a number, got 'thin'"),
        ({"material": "milk", "dilution": "half"}, "dilution must be a number, got 'half'"),
        ({"reflection": "false"}, "reflection must be true or false, got 'false'"),
        ({"eta": "1.3,1.4,1.5"}, r"eta must be one number for all channels, got \[1.3, 1.4, 1.5\]"),
    ],
)
def test_a_parameter_of_another_kind_is_refused_by_name_and_value(parameter, message):
    medium = {} if "material" in parameter else {"sigma_s": "1,2,3", "sigma_a": 0.1}
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "translucent", **medium, **parameter})


def test_an_unknown_parameter_in_a_file_is_refused_by_name():
    scene = (
        '<scene version="3.0.0"><bsdf type="translucent"><string name="material" value="marble"/>'
        '<string name="modle" value="neural"/></bsdf></scene>'
    )
    with pytest.raises(Exception, match="got 'modle'; did you mean 'model'"):
        mi.load_string(scene)


def test_a_dilution_without_a_material_is_refused():
    with pytest.raises(Exception, match="dilution must be left out without material, got 0.5"):
        mi.load_dict({**surface(), "dilution": 0.5})


@pytest.mark.parametrize("plugin", ["bssrdf", "translucent_walk"])
def test_what_mitsuba_reads_of_an_integrator_is_allowed(plugin):
    mi.load_dict({"type": plugin, "block_size": 16, "timeout": 5.0, "hide_emitters": True})


def test_an_unknown_material_is_refused_with_the_nearest_name():
    refused("did you mean 'marble'", view({**SPHERE, "bsdf": {"type": "translucent", "material": "marbel"}}))


def test_a_surface_without_material_is_refused():
    refused("must have material, or sigma_s and sigma_a", view({**SPHERE, "bsdf": {"type": "translucent"}}))


def test_orders_that_the_model_cannot_give_are_refused():
    refused("orders must be total", view({**SPHERE, "bsdf": surface("directional_dipole", "multiple")}))


def test_a_boundary_of_another_index_than_the_medium_is_refused():
    bsdf = {**surface(), "boundary": {"type": "dielectric", "int_ior": 1.9, "ext_ior": 1.0}}
    refused("boundary must be a dielectric", view({**SPHERE, "bsdf": bsdf}))


def test_a_camera_inside_the_object_is_refused():
    refused("camera must be outside", view({**SPHERE, "bsdf": surface()}, distance=1.0))


def test_a_scene_without_translucent_object_is_refused():
    refused("must have an object with a translucent BSDF", view(SPHERE))


@pytest.mark.parametrize(
    "settings", [{"mm_per_unit": 0.0}, {"area_share": 1.5}, {"max_depth": 0}, {"rr_depth": 0}, {"layers": 1}]
)
def test_settings_out_of_range_are_refused_by_name(settings):
    ((name, value),) = settings.items()  # Mitsuba names a setting that nobody reads, too
    refused(f"{name} must be .* got {value!r}", view({**SPHERE, "bsdf": surface()}, **settings))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_units_wrong_by_a_thousand_are_warned_of_with_the_size_in_mean_free_paths(factor):
    scene = view({**SPHERE, "bsdf": surface()}, mm_per_unit=factor)
    with pytest.warns(UserWarning, match="mean free paths across"):
        render(scene, 1)


def test_an_object_with_a_hole_is_warned_of():
    with pytest.warns(UserWarning, match="not closed"):
        render(view({"type": "cylinder", "radius": 4.0, "bsdf": surface()}), 1)


@pytest.mark.parametrize(
    "medium",
    [
        {**MEDIUM, "eta": 1.0},
        {"sigma_s": "1.0, 0.0, 0.5", "sigma_a": 0.2, "g": 0.0, "eta": 1.3},
        {"sigma_s": 1e-3, "sigma_a": 1e-4, "g": 0.0, "eta": 1.3},
        {"sigma_s": 400.0, "sigma_a": 1e-4, "g": 0.9, "eta": 1.5},
    ],
    ids=["eta 1", "one channel without scattering", "smaller than a mean free path", "many mean free paths"],
)
@pytest.mark.parametrize("orders", ["total", "single"])
def test_media_at_the_edge_stay_finite_and_not_negative(medium, orders):
    if orders == "total" and medium["sigma_s"] == 1e-3:  # of which no half-space knows all orders
        with pytest.raises(ValueError, match="must let at most 25 % of the light pass unscattered"):
            quietly(view({**SPHERE, "bsdf": surface(orders=orders, medium=medium)}))
        return
    image = quietly(view({**SPHERE, "bsdf": {**surface(orders=orders, medium=medium), "reflection": True}}))
    assert np.isfinite(image).all() and image.min() >= 0


def test_a_channel_without_scattering_is_black():
    medium = {"sigma_s": "1.0, 0.0, 0.5", "sigma_a": 0.2, "g": 0.0, "eta": 1.3}
    image = quietly(view({**SPHERE, "bsdf": surface(orders="total", medium=medium)}), 16)
    middle = image[6:10, 6:10].mean(axis=(0, 1))
    assert middle[1] == 0 and middle[0] > 0.1 and middle[2] > 0.05


def test_flipped_normals_of_a_closed_object_change_nothing():
    flipped = [quietly(view({**SPHERE, "flip_normals": flip, "bsdf": surface()}), 64) for flip in (False, True)]
    assert np.allclose(*(image.mean(axis=(0, 1)) for image in flipped), rtol=0.01)


def test_many_samples_do_not_hang():
    image = quietly(view({**SPHERE, "bsdf": surface()}, n=8), 4096)
    assert np.isfinite(image).all()


def test_objects_of_different_models_stand_side_by_side_with_ordinary_ones():
    at = mi.ScalarTransform4f()
    scene = view({**SPHERE, "radius": 1.5, "bsdf": surface("standard_dipole")}, n=24)
    scene["other"] = {"type": "sphere", "center": [3.2, 0, 0], "radius": 1.5, "bsdf": surface("better_dipole")}
    floor = at.translate([0, 0, -3]).scale(8.0)
    scene["floor"] = {"type": "rectangle", "to_world": floor, "bsdf": {"type": "diffuse"}}
    image = quietly(scene, 16)
    assert np.isfinite(image).all() and image.std() > 0.01


def test_a_variant_switch_keeps_the_plugins():
    for variant in ("llvm_ad_mono", "scalar_rgb", "llvm_ad_rgb"):
        mi.set_variant(variant)
    assert np.isfinite(quietly(view({**SPHERE, "bsdf": surface()}))).all()


def test_other_integrators_see_the_reflection_only():
    scene = view({**SPHERE, "bsdf": {**surface(), "reflection": True}}, hide_emitters=True, n=24)
    scene["integrator"] = {"type": "path", "hide_emitters": True}
    image = quietly(scene, 64)
    F = ((1.4 - 1) / (1.4 + 1)) ** 2
    assert abs(image[11:13, 11:13].mean() - F) < 0.1 * F


def test_a_lamp_lights_a_sphere_by_single_scattering_as_in_the_walk():
    """Connections through the curved boundary against walks that find the lamp by chance; the walk alone counts light
    that is reflected inside on its way, next to nothing at this index."""
    medium = {**MEDIUM, "eta": 1.08}
    lamp = {"type": "sphere", "center": [12, 3, 12], "radius": 4.0, "emitter": {"type": "area", "radiance": 3.0}}
    bsdf = surface(orders="single", medium=medium)
    scene = view({**SPHERE, "bsdf": bsdf}, lamp, n=12, hide_emitters=True, max_depth=2)
    connected = quietly(scene, 1024)
    walked = quietly({**scene, "integrator": {"type": "translucent_walk", "hide_emitters": True}}, 4096)
    lit = walked.mean(axis=2) > 0.1 * walked.max()
    assert abs(connected[lit].mean() / walked[lit].mean() - 1) < 0.02


def test_the_environment_may_have_any_colour():
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 0.5, 0.0]}}
    image = quietly(view({**SPHERE, "bsdf": surface()}, sky, hide_emitters=True), 16)
    mean = image.mean(axis=(0, 1))
    assert mean[2] == 0 and abs(mean[1] / mean[0] - 0.5) < 0.01


@pytest.mark.slow
def test_the_command_renders_a_file_in_a_process_of_its_own(tmp_path):
    file = tmp_path / "ball.xml"
    file.write_text(XML)
    run = [*START, "render", str(file), "--spp", "4", "--out", str(tmp_path / "out")]
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {".exr", ".json", ".png"} <= {p.suffix for p in (tmp_path / "out").iterdir()}


XML = """<scene version="3.0.0">
  <integrator type="bssrdf"><integer name="max_depth" value="3"/></integrator>
  <emitter type="constant"/>
  <shape type="sphere"><float name="radius" value="5"/>
    <bsdf type="translucent"><string name="material" value="marble"/><string name="model" value="better_dipole"/></bsdf>
  </shape>
  <sensor type="perspective"><float name="fov" value="20"/>
    <transform name="to_world"><lookat origin="0,0,40" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
  </sensor>
</scene>
"""


def test_sunlight_is_visible_only_where_nothing_stands_in_its_way():
    at = mi.ScalarTransform4f()
    scene = plane_scene(surface(), sun(0.0, 0.0), 30.0)
    scene["shade"] = {"type": "rectangle", "to_world": at.translate([0, 0, 50]).scale(200.0)}
    assert quietly(scene).max() == 0
