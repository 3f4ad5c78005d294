"""Derivatives by the medium through the network of all shapes, against other media that are held to walks anew."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
pytest.importorskip("igl")

from differentiated import Shifted, derivatives, image, varied  # noqa: E402

from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.transport.any_shape import transport  # noqa: E402
from full_geometry.transport.exit_pairs import trace_exits  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")

RADIUS, MEDIUM = 3.0, {"albedo": 0.9, "sigma_t": 0.3, "g": 0.2}
WIDEST_Z = 4.0


def _light(medium: dict[str, float], seed: int) -> tuple[float, float]:
    """ln B of a ball by walks, and its standard error."""
    obj = object_of(mi.load_dict({"type": "sphere", "radius": RADIUS}), Medium.from_albedo(**medium, eta=1.3))
    starts = obj.random_points(generator(mi, 2**18, pass_seed(seed)))
    T = np.array(trace_exits(obj, starts, (seed, 1)).T, dtype=float)
    return float(np.log(T.mean())), float(T.std() / T.mean() / np.sqrt(T.size))


@pytest.mark.slow
def test_as_much_light_leaves_by_a_medium_beside_as_by_its_walks() -> None:
    obj = object_of(mi.load_dict({"type": "sphere", "radius": RADIUS}), Medium.from_albedo(**MEDIUM, eta=1.3))
    model = transport(obj)
    for parameter, h in (("albedo", 0.05), ("sigma_t", 0.06), ("g", 0.15)):
        found, walked = [], []
        for k, side in enumerate((-h, h)):
            medium = {**MEDIUM, parameter: MEDIUM[parameter] + side}
            found.append(np.log(model.held.spread(model.perturbed([Medium.from_albedo(**medium, eta=1.3)]))[0]))
            walked.append(_light(medium, 11 + k))
        (below, e_below), (above, e_above) = walked
        noise = np.sqrt(2) * np.hypot(e_below, e_above)  # that of the scores is as large
        assert abs((found[1] - found[0]) - (above - below)) < WIDEST_Z * noise


@pytest.mark.slow
def test_derivatives_of_images_are_those_along_the_same_paths() -> None:
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    view = mi.ScalarTransform4f().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0])
    inside = {"type": "translucent", **MEDIUM, "eta": 1.3, "orders": "multiple", "reflection": False}
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant"}, "ball": {"type": "sphere", "radius": RADIUS, "bsdf": inside},
        "integrator": {"type": "bssrdf", "model": "neural_shape", "hide_emitters": True, "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 12.0, "to_world": view, "film": film},
    })  # fmt: skip
    (body,), h = scene.integrator().prepare(scene), 0.01
    sides = [image(scene, [varied(body, Shifted(body, "sigma_t", side, None))]) for side in (-h, h)]
    expected = (sides[1] - sides[0]) / (2 * h)
    found = derivatives(scene, ["ball.bsdf.sigma_t"], np.ones((4, 4, 1), np.float32))["ball.bsdf.sigma_t"]
    assert found.sum() == pytest.approx(expected.sum(), abs=1e-2 * np.abs(expected).sum())
