"""The mean light of the sky as a control variate: the same light with less noise, for a transport that knows it.

The transport is of no medium: S mu_i = R mu_i / (pi A), so that alpha = R exactly. Orders below two of a ball of index
1 that scatters isotropically are known by quadrature. z-tests are at 4 standard errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")

from rendered import independent, surface  # noqa: E402

from full_geometry.geometry.points import ObjectModel  # noqa: E402
from full_geometry.integrators.lighting import EnvironmentMean, Lights  # noqa: E402
from full_geometry.transport import models, prepare  # noqa: E402
from full_geometry.transport.half_space import half_space_model  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

R, SIGMA_S, SIGMA_A = 0.5, 1.2, 0.3
MEDIUM = {"sigma_s": SIGMA_S, "sigma_a": SIGMA_A, "g": 0.0, "eta": 1.0}
KNOTS = 256


def once_of_ball(mu: np.ndarray) -> np.ndarray:
    """What passes a ball of radius 1 and leaves it after one event, of light from everywhere, seen at the cosine mu."""
    sigma_t, found = SIGMA_S + SIGMA_A, np.exp(-2 * mu * (SIGMA_S + SIGMA_A))
    x, w = np.polynomial.legendre.leggauss(64)
    for k, m in enumerate(mu):
        s = m * (x + 1)  # along the chord
        rho = np.sqrt(1 + s**2 - 2 * s * m)[:, None]
        out = -rho * x + np.sqrt(1 - rho**2 * (1 - x**2))
        escape = (np.exp(-sigma_t * out) * w).sum(axis=1) / 2
        found[k] += (m * w * SIGMA_S * np.exp(-sigma_t * s) * escape).sum()
    return found


class Even:
    """S = R / (pi A), which has the share R of even light."""

    orders, checksums, alpha, is_delta = "multiple", (), None, False

    def __init__(self, area: float) -> None:
        self.scale = R / (np.pi * area)

    def prepare(self, out, active):
        return None

    def S(self, exit, at, active):
        return mi.Spectrum(self.scale)


class Known(Even):
    """The same, which knows it."""

    def __init__(self, area: float) -> None:
        super().__init__(area)
        self.once = mi.Texture1f(mi.TensorXf(once_of_ball((np.arange(KNOTS) + 0.5) / KNOTS)[:, None]))
        self.alpha = self

    @property
    def known(self):
        return mi.Spectrum(1), mi.Spectrum(1)

    def __call__(self, at, active):
        return mi.Spectrum(self.once.eval(mi.Point1f(dr.dot(at.w, at.n_out)))[0]), mi.Spectrum(R)


def scene(kind: type, patch: pytest.MonkeyPatch, light: dict, **integrator) -> dict:
    """A ball with a transport, in light."""

    def means(obj, inside, settings):
        proposals = half_space_model("better_dipole", obj.geometry, obj.media, settings).proposals
        return ObjectModel(kind(obj.geometry.area), proposals, 2)

    patch.setattr(prepare, "_model_of", means)
    patch.setattr(models, "HALF_SPACE", replace(models.HALF_SPACE, straight=True))
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0]).scale(0.6)
    return {
        "type": "scene", "integrator": {"type": "bssrdf", "max_depth": 6, "area_share": 1.0, **integrator},
        "ball": {"type": "sphere", "bsdf": surface("better_dipole", "total", MEDIUM)},
        "sensor": {"type": "orthographic", "to_world": view, "film": film}, **light,
    }  # fmt: skip


def images(found: dict, spp: int = 64, runs: int = 16) -> np.ndarray:
    loaded = mi.load_dict(found)
    return independent(loaded, runs, spp)


def lights(name: str) -> dict:
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 0.6, 0.3]}}
    if name == "clouds":
        row, column = np.meshgrid(np.linspace(0, np.pi, 16), np.linspace(0, 2 * np.pi, 32), indexing="ij")
        clouds = 1 + 0.5 * np.cos(row) + 0.3 * np.sin(row) * np.cos(3 * column)
        sky = {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(clouds[:, :, None], 3, axis=2).astype(np.float32))}
    found = {"sky": sky}
    if name != "sky":
        down = mi.ScalarTransform4f().translate([0, -1.02, 0]).rotate([1, 0, 0], -90).scale(3)
        grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}
        found["floor"] = {"type": "rectangle", "to_world": down, "bsdf": grey}
        found["lamp"] = {
            "type": "sphere",
            "center": [1, 2, 2],
            "radius": 0.3,
            "light": {"type": "area", "radiance": 9.0},
        }
        found["point"] = {"type": "point", "position": [-2, 2, 2], "intensity": 2.0}
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("light", "entries"), [("lamps and floor", 3), ("clouds", 1)])
def test_the_light_is_that_without_it(light: str, entries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [images(scene(kind, monkeypatch, lights(light), entries=entries)) for kind in (Even, Known)]
    (a, a_error), (b, b_error) = ((r.mean(axis=(1, 2)).mean(axis=0), _error(r)) for r in runs)
    assert np.all(np.abs(a - b) < 4 * np.hypot(a_error, b_error)) and np.all(a_error < 0.01 * a)


def _error(runs: np.ndarray) -> np.ndarray:
    return runs.mean(axis=(1, 2)).std(axis=0, ddof=1) / np.sqrt(len(runs))


def test_nothing_is_random_under_an_even_sky_that_nothing_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {kind: images(scene(kind, monkeypatch, lights("sky")), 16, 4)[:, 5:7, 5:7] for kind in (Even, Known)}
    noise = {kind: (runs.std(axis=0, ddof=1) / runs.mean(axis=0)).mean() for kind, runs in found.items()}
    assert noise[Known] < 1e-3 < 0.05 < noise[Even]


def test_the_radiance_of_the_sky_times_its_derivative_is_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    light = lights("lamps and floor")
    found = mi.load_dict(scene(Known, monkeypatch, {name: light[name] for name in ("sky", "floor")}))
    parameters = mi.traverse(found)
    key = "sky.radiance.value"
    dr.enable_grad(parameters[key])
    image = mi.render(found, parameters, spp=512)
    dr.backward(dr.mean(image))
    product = np.array(dr.grad(parameters[key])).ravel() * np.array(dr.detach(parameters[key])).ravel()
    assert np.allclose(product.sum(), np.array(dr.detach(image)).mean(), rtol=0.01)


def test_a_sky_with_a_sun_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def mean(sun: float) -> object:
        map = np.full((16, 32, 3), 0.2, np.float32)
        map[4, 5] = sun
        loaded = mi.load_dict(scene(Known, monkeypatch, {"sky": {"type": "envmap", "bitmap": mi.Bitmap(map)}}))
        return EnvironmentMean.of(loaded, Lights.of(loaded), loaded.integrator().prepare(loaded))

    assert np.allclose(np.array(mean(0.2).mean), 0.2, rtol=1e-3) and mean(500.0) is None
