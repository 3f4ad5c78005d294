"""What Mitsuba's integrator `aov` sees of translucent objects: directional albedo, shading normal and depth."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from full_geometry import register
from halfspace_sss import Medium

ALBEDOS, G, ETA = [0.999, 0.9, 0.4], 0.6, 1.4
FLOOR = [0.3, 0.5, 0.7]
NEAR = 0.01  # where rays of the camera start


@pytest.fixture(scope="module", autouse=True)
def plugins() -> None:
    mi.set_variant("llvm_ad_rgb")
    register()


def _colour(values: Any) -> str:
    return ", ".join(map(str, values))


def _aovs(scene: dict[str, Any], aovs: str = "albedo:albedo,nn:sh_normal,dd:depth") -> np.ndarray:
    """The AOVs at the origin, seen from a distance of 5 in the direction (0.6, 0, 0.8)."""
    sensor = {
        "type": "orthographic",
        "near_clip": NEAR,
        "to_world": mi.ScalarTransform4f().look_at([3, 0, 4], [0, 0, 0], [0, 1, 0]).scale([0.01, 0.01, 1]),
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
    }
    loaded = mi.load_dict({"type": "scene", "sensor": sensor, **scene})
    integrator = mi.load_dict({"type": "aov", "aovs": aovs})
    return np.array(mi.render(loaded, integrator=integrator, spp=1))[0, 0]


def _square(surface: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"type": "rectangle", "bsdf": surface, **more}


PLAIN = {"type": "translucent", "sigma_t": 2.0, "albedo": _colour(ALBEDOS), "g": G, "eta": ETA}


def test_the_albedo_is_the_reflectance_towards_the_camera_beside_a_painted_floor() -> None:
    floor = _square({"type": "diffuse", "reflectance": {"type": "rgb", "value": FLOOR}})
    floor["to_world"] = mi.ScalarTransform4f().translate([0, 0, -1]).scale(20)
    rough = {"type": "roughdielectric", "alpha": 0.2, "int_ior": ETA, "ext_ior": 1.0}
    wanted = Medium.from_albedo(np.array(ALBEDOS), 2.0, G, ETA).reflectance(0.8)
    for surface in (PLAIN, {**PLAIN, "boundary": rough}):
        found = _aovs({"object": _square(surface), "floor": floor})
        np.testing.assert_allclose(found[:3], wanted, rtol=2e-3)
        np.testing.assert_allclose(found[3:], [0, 0, 1, 5 - NEAR], atol=1e-4)
    np.testing.assert_allclose(_aovs({"floor": floor})[:3], FLOOR, rtol=1e-5)


def test_where_the_medium_varies_the_albedo_is_that_of_the_medium_here() -> None:
    grid = np.zeros((1, 1, 2, 1), dtype=np.float32) + np.array([0.2, 0.95], dtype=np.float32)[:, None]
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(grid), "raw": True, "filter_type": "nearest"}
    volume["to_world"] = mi.ScalarTransform4f().translate([-1.3, -1, -1]).scale(2)  # the right half is at the origin
    found = _aovs({"object": _square({"type": "translucent", "sigma_t": 2.0, "albedo": volume, "eta": ETA})})
    np.testing.assert_allclose(found[:3], Medium.from_albedo(0.95, 2.0, 0.0, ETA).reflectance(0.8), rtol=2e-3)


def test_the_albedo_follows_an_edit_of_the_medium() -> None:
    surface = mi.load_dict(PLAIN)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(0.6, 0, -0.8)  # from behind the normal: always seen from outside
    before = np.ravel(surface.eval_diffuse_reflectance(si))
    parameters = mi.traverse(surface)
    parameters["albedo"], parameters["g"] = mi.Color3f(0.7), mi.Color3f(0.0)
    parameters.update()
    after = np.ravel(surface.eval_diffuse_reflectance(si))
    np.testing.assert_allclose(after, Medium.from_albedo(0.7, 2.0, 0.0, ETA).reflectance(0.8), rtol=2e-3)
    assert abs(before[0] - after[0]) > 0.1
