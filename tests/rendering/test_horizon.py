"""Directions above a surface but below the horizon of its interpolated normal: no light is lost or made there."""

from __future__ import annotations

import numpy as np
import pytest
from coarse import coarse_ball
from rendered import direction, independent
from scipy import stats

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")

PASSES = 8
CLEAR = {"sigma_s": 1e-3, "sigma_a": 0.0}
THICK = {"sigma_s": 20.0, "sigma_a": 0.0}


@pytest.fixture(autouse=True)
def _variant():
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


def images(shape: dict, bsdf: dict, light: dict, spp: int = 64, **integrator) -> np.ndarray:
    """Independent images of pixels that the ball fills, grey, stacked first."""
    at = mi.ScalarTransform4f().look_at((8 * direction(50, 40)).tolist(), [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    scene = {"type": "scene", "integrator": {"hide_emitters": True, **integrator}, "light": light,
             "ball": {**shape, "bsdf": bsdf},
             "sensor": {"type": "perspective", "fov": 16.0, "to_world": at, "film": film}}  # fmt: skip
    scene = mi.load_dict(scene)
    found = independent(scene, PASSES, spp, pixel_format="rgba")
    covered = (found[..., 3] == 1).all(axis=0)
    assert covered.mean() > 0.5
    return found[:, covered, :3].mean(axis=2)


def medium(**values) -> dict:
    return {"type": "translucent", "model": "better_dipole", "g": 0.0, "eta": 1.3, **values}


def test_a_direction_below_the_horizon_sees_a_normal_as_far_above_it():
    from full_geometry.geometry.points import lifted

    m, n, w = mi.Normal3f(0.6, 0, 0.8), mi.Normal3f(0, 0, 1), dr.normalize(mi.Vector3f(-0.9, 0.1, 0.3))
    found = lifted(m, n, w)
    assert dr.dot(m, w)[0] < 0 and dr.dot(found, w)[0] == pytest.approx(-dr.dot(m, w)[0], abs=1e-6)
    assert dr.norm(found)[0] == pytest.approx(1, abs=1e-6)
    assert np.allclose(np.array(lifted(m, n, mi.Vector3f(n))), np.array(m))


def test_the_axes_of_a_rough_boundary_tilt_with_the_normal_that_is_seen():
    """Along x, by far less than 45 degrees; new axes from the normal alone are along its own x and y."""
    from full_geometry.geometry.points import lift

    si, w = dr.zeros(mi.SurfaceInteraction3f), dr.normalize(mi.Vector3f(-0.95, 0.1, 0.2))
    m = dr.normalize(mi.Normal3f(0.3, 0.1, 1))
    s = dr.normalize(dr.cross(mi.Vector3f(1, -1, 0), m))  # across the diagonal
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(s, dr.cross(m, s), m)
    si.wi = si.to_local(w)
    seen = lift(mi.SurfaceInteraction3f(si), w)
    assert dr.dot(m, w)[0] < 0 < mi.Frame3f.cos_theta(seen.wi)[0]
    assert dr.dot(seen.sh_frame.s, s)[0] > 0.97
    assert np.allclose(np.array(seen.to_world(seen.wi)), np.array(w), atol=1e-6)
    assert dr.dot(dr.cross(seen.sh_frame.s, seen.sh_frame.t), seen.sh_frame.n)[0] == pytest.approx(1, abs=1e-6)


def test_directions_are_above_the_surface_and_of_the_density_that_is_stated():
    """Mean of 1/density is the solid angle 2 pi of all directions above, of cos²/density its integral 2 pi / 3."""
    from full_geometry.geometry.points import cosine_above, cosine_density

    rng, n = mi.PCG32(2**20), mi.Normal3f(0, 0, 1)
    w, pdf = cosine_above(mi.Normal3f(0.6, 0, 0.8), n, mi.Point2f(rng.next_float32(), rng.next_float32()))
    assert dr.all(w.z >= 0)
    assert np.allclose(np.array(pdf), np.array(cosine_density(mi.Normal3f(0.6, 0, 0.8), n, w)))
    for value, integral in ((np.array(w.z) ** 2, 2 * np.pi / 3), (np.array(w.x) * np.array(w.z), 0.0)):
        parts = value / np.array(pdf)
        assert abs(parts.mean() - integral) < 4 * parts.std() / np.sqrt(len(parts))


@pytest.mark.parametrize("values", [CLEAR, THICK], ids=["clear", "thick"])
def test_without_absorption_each_pixel_of_a_coarse_ball_is_as_bright_as_the_sky(values, tmp_path):
    """z-tests of the mean and of all pixels at a significance of 1e-4; a pixel without noise is exact."""
    found = images(coarse_ball(tmp_path), medium(**values), {"type": "constant"}, type="translucent_walk")
    for parts in (found.mean(axis=1, keepdims=True), found):
        noisy = parts.std(axis=0) > 1e-5
        assert np.allclose(parts[:, ~noisy], 1, atol=1e-4)
        p = stats.ttest_1samp(parts[:, noisy], 1).pvalue
        assert p.size == 0 or p.min() * p.size > 1e-4


def test_a_diffuse_surface_returns_its_reflectance_at_each_pixel_of_a_coarse_ball(tmp_path):
    from halfspace_sss import Medium

    bsdf = medium(sigma_s=1.0, sigma_a=0.05, reflection=False)
    found = images(coarse_ball(tmp_path), {**bsdf, "model": "lambert"}, {"type": "constant"}, type="bssrdf")
    assert np.allclose(found, float(Medium(1.0, 0.05, 0.0, 1.3).reflectance()), rtol=1e-4)
