"""The network of TG et al. 2023 for distant light: its walks, what it learns, and the light at a point."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

from benchmarks.published import distant_light  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from halfspace_sss import Medium  # noqa: E402
from halfspace_sss.physics.fresnel import F_t  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")

ETA = 1.4


@pytest.fixture(scope="module")
def white() -> TranslucentObject:
    mi.set_variant("llvm_ad_rgb")
    sphere = mi.load_dict({"type": "sphere", "radius": 1.5})
    return object_of(sphere, Medium(np.full(3, 3.0), np.zeros(3), 0.0, ETA))


def test_walks_without_absorption_bring_all_light_that_enters(white: TranslucentObject) -> None:
    exits = white.random_points(generator(mi, 2**14, pass_seed(3)))
    walks = distant_light.distant_walks(white, exits, (4,))
    lost = walks.T[:, 0] - F_t(np.array(exits.mu, dtype=float), ETA)
    assert abs(lost.mean()) < 4 * lost.std() / np.sqrt(len(lost)) + 1e-6
    found = walks.T[:, 0] > 0
    np.testing.assert_allclose(np.linalg.norm(walks.x[found, 6:], axis=1), 1, atol=1e-4)


@pytest.mark.slow
def test_the_network_of_distant_light_learns_where_light_comes_from(
    white: TranslucentObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a white ball: the mean over lights of f and of f times the cosine at the exit are those of walks."""
    monkeypatch.setattr(distant_light, "CHUNK", 2**13)
    net = distant_light.fit_distant(white, 1.0, steps=110)
    exits = white.random_points(generator(mi, 2**10, pass_seed(5)))
    walks = distant_light.distant_walks(white, exits, (6,))
    p, w_o, w = np.split(walks.x, 3, axis=1)
    n = p / np.linalg.norm(p, axis=1, keepdims=True)
    lights = np.random.default_rng(0).standard_normal((64, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    f = np.stack([net.radiance(p, w_o, light[None], np.ones((1, 3)))[:, 0] for light in lights])
    T = walks.T[:, 0]
    assert 4 * np.pi * f.mean() == pytest.approx(T.mean(), rel=0.1)
    assert 4 * np.pi * (f * (lights @ n.T)).mean() == pytest.approx((T * (w * n).sum(axis=1)).mean(), rel=0.2)


def test_light_at_a_point_is_that_of_its_surroundings() -> None:
    glow = {"type": "area", "radiance": 40.0}
    lamp = {"type": "sphere", "center": [0, 0, 5], "radius": 0.5, "emitter": glow}
    sky = {"type": "constant"}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sky": sky, "lamp": lamp})
    w, E = distant_light.incident(scene, np.zeros(3))
    solid = 2 * np.pi * (1 - np.sqrt(1 - 0.1**2))
    assert E.sum(axis=0) == pytest.approx(4 * np.pi + 39 * solid, rel=0.03)
    assert w[E[:, 0].argmax()][2] > 0.95
