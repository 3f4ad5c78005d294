"""Light that passes an object straight, which no half-space knows: its share, and who refuses the object."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from halfspace_sss import Medium

mi = pytest.importorskip("mitsuba")

from full_geometry.geometry.shape import analyse_shape  # noqa: E402
from full_geometry.transport.half_space import MOST_STRAIGHT, straight_share  # noqa: E402
from halfspace_sss.registry import models  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

LARGEST_ERROR = 0.01  # of 2^14 lines, of which a third to all meet an object


def _ball(model: str = "neural", radius: float = 20.0, **surface: Any) -> dict[str, Any]:
    surface = surface or {"material": "apple juice"}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at([0, 0, 20 * radius], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene", "sky": {"type": "constant"},
        "ball": {"type": "sphere", "radius": radius, "bsdf": {"type": "translucent", "model": model, **surface}},
        "sensor": {"type": "perspective", "fov": 3.0, "to_world": at, "film": film},
    }  # fmt: skip


def _prepare(scene: dict[str, Any], **settings: Any) -> list[Any]:
    return mi.load_dict({"type": "bssrdf", **settings}).prepare(mi.load_dict(scene))


@pytest.mark.parametrize("material", ["apple juice", "sprite", "chardonnay"])
@pytest.mark.parametrize("model", [*models(), "lambert"])
def test_models_of_the_half_space_refuse_a_clear_liquid_by_name(model: str, material: str) -> None:
    if model in ("neural_material", "neural_paper"):
        pytest.skip("trained for one medium each")
    with pytest.raises(ValueError, match=f"pass unscattered.*under the model '{model}', got .*translucent_walk"):
        _prepare(_ball(model, material=material))


def test_single_orders_and_what_turns_light_are_not_refused() -> None:
    for orders in ("single", "multiple"):
        _prepare(_ball(), orders=orders)
    _prepare(_ball(material="ketchup"))
    _prepare(_ball(sigma_s=0.0, sigma_a=0.01))  # nothing scatters: light passes it, and is traced


@pytest.mark.parametrize("tau", [0.3, 1.0, 3.0])
def test_the_share_of_a_ball_and_of_a_cube_is_that_of_their_chords(tau: float) -> None:
    """Of a ball of index 1, ∫ 2 mu exp(-tau mu) dmu; of a cube by lines through it that are drawn here."""
    media = [Medium(0.0, tau / 2, 0.0, 1.0), Medium(tau, 0.0, 0.5, 1.0), Medium(tau / 2, 0.0, -0.5, 1.0)]
    expected = 2 * (1 - (1 + tau) * np.exp(-tau)) / tau**2
    np.testing.assert_allclose(
        straight_share(analyse_shape(mi.load_dict({"type": "sphere"})), media), expected, atol=LARGEST_ERROR
    )
    rng = np.random.default_rng(3)
    start = np.column_stack([rng.uniform(-1, 1, (2**17, 2)), np.full(2**17, -1.0)])  # on a face, by the cosine
    mu, phi = np.sqrt(rng.random(2**17)), 2 * np.pi * rng.random(2**17)
    d = np.column_stack([np.sqrt(1 - mu**2) * np.cos(phi), np.sqrt(1 - mu**2) * np.sin(phi), mu])
    ways = ((np.sign(d) - start) / d).min(axis=1)
    cube = straight_share(analyse_shape(mi.load_dict({"type": "cube"})), media)
    np.testing.assert_allclose(cube, np.exp(-tau / 2 * ways).mean(), atol=LARGEST_ERROR)


def test_no_light_passes_a_plane() -> None:
    with pytest.warns(UserWarning, match="not closed"):
        plane = analyse_shape(mi.load_dict({"type": "rectangle"}))
    assert straight_share(plane, [Medium(0.0, 1e-3, 0.0, 1.4)]) == 0


@pytest.mark.parametrize("g", [0.0, 0.9])
def test_at_the_bound_models_of_the_half_space_are_half_as_bright_as_walks(g: float) -> None:
    """A ball that is just refused, and one that is just not: both are far off, so that the bound is none too low."""
    images = {}
    for sigma_t_prime in (0.78, 0.85):
        sigma_t = sigma_t_prime / (1 - 0.5 * g)
        surface = {"albedo": 0.5, "sigma_t": sigma_t, "g": g, "eta": 1.4, "reflection": False}
        scene = _ball(radius=1.0, **surface)
        if sigma_t_prime < 0.8:
            with pytest.raises(ValueError, match=re.escape(f"at most {100 * MOST_STRAIGHT:g} %")):
                _prepare(scene)
            continue
        for kind in ("bssrdf", "translucent_walk"):
            images[kind] = np.array(mi.render(mi.load_dict({**scene, "integrator": {"type": kind}}), spp=64)).mean()
    assert 0.3 < images["bssrdf"] / images["translucent_walk"] < 0.5
