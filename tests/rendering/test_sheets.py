"""Surfaces with a thickness: against discrete ordinates of others, their own densities, and walks in a thin box."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

CHANNELS = [(0.9, 0.0), (0.99, 0.8), (0.6, -0.4)]  # albedo and g


def _surface(eta: float, **more: object) -> dict[str, object]:
    albedo, g = (", ".join(map(str, values)) for values in zip(*CHANNELS))
    return {"type": "translucent", "albedo": albedo, "sigma_t": 2.0, "g": g, "eta": eta} | more


def _met(mu: float) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(math.sqrt(1 - mu * mu), 0, mu)
    return si


@pytest.mark.parametrize(("tau", "mu_i"), [(0.5, 0.8), (4.0, 0.4)])
def test_it_scatters_as_discrete_ordinates_say(tau: float, mu_i: float) -> None:
    """nanodisort has no boundary; with one, slabs of the same solver are held against adding-doubling elsewhere."""
    nanodisort = pytest.importorskip("nanodisort")
    azimuths, cosines = np.array([0.0, 60.0, 180.0]), np.array([-0.9, -0.5, -0.3, 0.3, 0.6, 0.95])
    surface, found = mi.load_dict(_surface(1.0, thickness=tau / 2)), []
    for mu in cosines:
        sine, phi = math.sqrt(1 - mu * mu), np.radians(azimuths)
        # light that travels at azimuth 180 degrees; what goes down is below
        wo = mi.Vector3f(*(mi.Float(list(v)) for v in (-sine * np.cos(phi), sine * np.sin(phi), 0 * phi + mu)))
        found.append(np.array(surface.eval(mi.BSDFContext(), _met(mu_i), wo)) / abs(mu))
    for k, (albedo, g) in enumerate(CHANNELS):
        state = nanodisort.DisortState()
        state.nstr, state.nlyr, state.nmom, state.ntau, state.nphase = 48, 1, 400, 2, 2001
        state.numu, state.nphi = len(cosines), len(azimuths)
        state.usrtau = state.usrang = state.lamber = state.quiet = state.intensity_correction = True
        state.onlyfl = state.planck = state.old_intensity_correction = False
        state.fbeam, state.umu0, state.phi0, state.fisot, state.albedo = 1 / mu_i, mu_i, 0.0, 0.0, 0.0
        state.allocate()
        state.mu_phase = np.cos(np.linspace(0.0, np.pi, state.nphase))
        state.phase = ((1 - g * g) / (1 + g * g - 2 * g * state.mu_phase) ** 1.5)[None]
        state.pmom = (float(g) ** np.arange(state.nmom + 1))[:, None]
        state.dtauc, state.ssalb, state.utau = np.array([tau]), np.array([albedo]), np.array([0.0, tau])
        state.umu, state.phi = cosines, azimuths
        state.solve()
        uu = np.array(state.uu)
        truth = np.where(cosines[:, None] > 0, uu[:, 0], uu[:, 1])
        assert np.allclose(np.array(found)[:, k], truth, rtol=0.01), (k, np.array(found)[:, k] / truth)


def test_samples_have_the_density_and_the_albedo_that_are_said() -> None:
    """Values and densities are integrated over directions; weights of samples have the means of the four components."""
    surface, si = mi.load_dict(_surface(1.4, thickness=0.5)), _met(0.6)
    n = 512
    u = [mi.Float(list(v.ravel())) for v in (np.mgrid[:n, :n].astype(np.float32) + 0.5) / n]
    values, pdfs = [], []
    for side in (1, -1):
        w = mi.warp.square_to_uniform_hemisphere(mi.Point2f(*u))
        w.z *= side
        value, pdf = surface.eval_pdf(mi.BSDFContext(), si, w)
        values.append(2 * np.pi * np.array(value).mean(axis=1))
        pdfs.append(2 * np.pi * float(dr.mean(pdf)[0]))
    rng = np.random.default_rng(1)
    numbers = [mi.Float(list(rng.random(2**18, dtype=np.float32))) for _ in range(3)]
    bs, weight = surface.sample(mi.BSDFContext(), si, numbers[0], mi.Point2f(*numbers[1:]))
    drawn, weight = np.array(bs.sampled_component), np.array(weight)
    means, shares = zip(*((np.where(drawn == k, weight, 0).mean(axis=1), (drawn == k).mean()) for k in range(4)))
    mirrored, straight = (np.ravel(v) for v in surface.sheet.unscattered(mi.Float(0.6)))
    by_table = [np.ravel(v) for v in surface.sheet.scattered(si, mi.Bool(True))]
    for found, truth in zip(means, [mirrored, straight, *values]):
        assert np.allclose(found, truth, rtol=0.02)
    assert np.allclose(by_table, values, rtol=4e-3)
    kept = np.abs(np.array(bs.wo.z)) > 0  # others are reflected inside, which their densities leave out
    assert sum(pdfs) == pytest.approx((kept & (drawn > 1)).mean(), rel=0.01)
    assert shares[2] + shares[3] == pytest.approx(1 - shares[0] - shares[1])


def _scene(thin: bool, side: int) -> mi.Scene:
    t, thick = mi.ScalarTransform4f(), 1.2
    inside = {"type": "translucent", "albedo": 0.98, "sigma_t": 2.0, "g": 0.6, "eta": 1.4}
    shape = {"type": "rectangle", "to_world": t.scale(30), "bsdf": inside | {"thickness": thick}}
    far = {"type": "sphere", "center": [0, 0, -400], "bsdf": inside}
    if not thin:
        shape = {"type": "cube", "to_world": t.scale([30, 30, thick / 2]), "bsdf": inside}
    eye = np.array([12.0, -16, side * 15])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "translucent_walk", "light": "sampled"}, "shape": shape, "far": far,
        "camera": {"type": "perspective", "fov": 2, "film": film,
                   "to_world": t.look_at(list(eye), [0, 0, 0], [0, 1, 0])},
        "lamp": {"type": "disk", "to_world": t.look_at([300, 0, 250], [0, 0, 0], [0, 1, 0]).scale(200),
                 "emitter": {"type": "area", "radiance": 1.0}},
    })  # fmt: skip


@pytest.mark.slow
def test_both_sides_look_as_walks_in_a_thin_box(mono: None) -> None:
    """Lit from one side at 50 degrees by a lamp of 27 degrees."""
    for side in (1, -1):
        sheet, box = (
            np.array(mi.render(_scene(thin, side), spp=spp, seed=3)).ravel()
            for thin, spp in ((True, 256), (False, 5000))
        )
        error = np.hypot(*(image.std() / math.sqrt(len(image)) / image.mean() for image in (sheet, box)))
        ratio = sheet.mean() / box.mean()
        assert error < 0.01, error
        assert abs(ratio - 1) < 0.02, (ratio, error)


REFUSED = [
    ({"thickness": 0.0}, "thickness must be a number in"),
    ({"thickness": math.inf}, "thickness must be a number in"),
    ({"model": "neural"}, "model must be left out of a surface with a thickness, got 'neural'"),
    ({"priority": 2.0}, "priority must be left out of a surface with a thickness"),
    ({"eta": 0.8}, "eta of a surface with a thickness must be >= 1, got 0.8"),
    ({"rough": {"type": "roughdielectric", "int_ior": 1.4, "ext_ior": 1.0}}, "must be smooth and without tints"),
    ({"sigma_t": {"type": "checkerboard"}}, "must have constants but for its albedo"),
]


@pytest.mark.parametrize(("more", "message"), REFUSED)
def test_what_no_sheet_has_is_refused(more: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mi.load_dict(_surface(1.4, thickness=0.3) | more)


def test_a_sheet_is_thinner_than_wide_and_outside_of_objects() -> None:
    t = mi.ScalarTransform4f()

    def render(scale: float, thickness: float) -> None:
        leaf = {"type": "rectangle", "to_world": t.scale(scale), "bsdf": _surface(1.4, thickness=thickness)}
        ball = {"type": "sphere", "radius": 4.0, "bsdf": {"type": "translucent", "material": "marble"}}
        rest = {"integrator": {"type": "translucent_walk"}, "sky": {"type": "constant"}, "ball": ball}
        camera = {"type": "perspective", "to_world": t.translate([0, 0, -20])}
        mi.render(mi.load_dict({"type": "scene", "leaf": leaf, "camera": camera} | rest), spp=1)

    with pytest.raises(ValueError, match="thickness of object .leaf. must be below its width of 4 mm, got 5 mm"):
        render(2.0, 5.0)
    with pytest.raises(
        ValueError, match="a surface with a thickness must be outside of objects, got .leaf. inside .ball."
    ):
        render(6.0, 0.1)


def test_a_texture_of_albedo_is_looked_up_between_tables() -> None:
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.93, np.float32))}
    common, found = {"sigma_t": 3.0, "g": 0.3, "eta": 1.4, "type": "translucent", "thickness": 1.0}, []
    for albedo in (0.93, texture):
        surface = mi.load_dict(common | {"albedo": albedo})
        for w in (mi.Vector3f(0.6, 0, 0.8), mi.Vector3f(0.6, 0, -0.8)):
            found.append(np.array(surface.eval(mi.BSDFContext(), _met(0.9), w)).ravel())
    assert np.allclose(found[:2], found[2:], rtol=0.01)
