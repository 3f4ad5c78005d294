"""Layers below the surface of an object: depths, the plane's own layers on a large ball, corrected light, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import halfspace_sss as sss
from full_geometry.surface.layered import LayeredMedium, depths_of, read_layers

pytestmark = pytest.mark.usefixtures("rgb")

dr, mi = pytest.importorskip("drjit"), pytest.importorskip("mitsuba")

COLOURS = "ketchup 0.1, apple 0.4, ketchup"


def _scene(radius: float, layers: str, fov: float = 3.0, **integrator: Any) -> Any:
    view = mi.ScalarTransform4f().look_at([0, 0, 4 * radius], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    surface = {"type": "translucent", "model": "better_dipole", "layers": layers, "reflection": False}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"max_depth": -1, **integrator},
            "sensor": {"type": "perspective", "fov": fov, "to_world": view, "film": film},
            "sky": {"type": "constant", "radiance": 1.0},
            "ball": {"type": "sphere", "radius": radius, "bsdf": surface},
        }
    )


def _geometry(shape: dict) -> Any:
    from full_geometry.geometry.shape import analyse_shape

    surface = {"type": "translucent", "layers": COLOURS}
    scene = mi.load_dict({"type": "scene", "object": {**shape, "bsdf": surface}})
    return analyse_shape(scene.shapes()[0], scene)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sphere", "cube"])
def test_depths_are_distances_to_the_nearest_point_of_the_surface(kind: str) -> None:
    geometry = _geometry({"type": kind})
    p = np.random.default_rng(2).uniform(-1, 1, (20_000, 3))
    depth = 1 - (np.linalg.norm(p, axis=1) if kind == "sphere" else np.abs(p).max(axis=1))
    shallow = (depth > 0) & (depth < 0.3)
    found = np.array(depths_of(geometry, 0.3).at(mi.Point3f(p[shallow].T.astype(np.float32))))
    error = np.abs(found - depth[shallow])
    assert np.median(error) < 0.001 and np.quantile(error, 0.99) < 0.004
    assert error[depth[shallow] < 0.03].max() < (0.001 if kind == "sphere" else 0.01)  # edges lie between nodes


@pytest.mark.slow
def test_a_large_ball_reflects_what_the_same_layers_below_a_plane_do() -> None:
    scene = _scene(40.0, "skin III", type="translucent_walk")
    image = np.array(mi.render(scene, spp=256, seed=3))
    error = image.std(axis=(0, 1)) / np.sqrt(image.shape[0] * image.shape[1]) / image.mean(axis=(0, 1))
    media, thickness = read_layers("skin III")
    for c in range(3):
        layers = sss.Layers([medium.channel(c) for medium in media], thickness)
        R, of_R = sss.trace(layers, n_paths=100_000).reflectance()
        assert abs(image[..., c].mean() / R - 1) < 0.02 + 2 * np.hypot(error[c], of_R / R)
        assert image[..., c].mean() > 1.5 * sss.trace(media[0].channel(c), n_paths=10_000).reflectance().value


@pytest.mark.slow
def test_corrected_light_has_the_mean_of_walks() -> None:
    images = []
    for integrator in ({"type": "translucent_walk"}, {"type": "bssrdf", "light": "corrected"}):
        with pytest.warns(UserWarning, match="varies in space") if len(images) else pytest.MonkeyPatch.context():
            scene = _scene(2.0, "skin1 0.1, apple 0.3, skin2", 29.5, **integrator)
            images.append(np.array(mi.render(scene, spp=512, seed=4)).mean(axis=(0, 1)))
    np.testing.assert_allclose(images[1], images[0], rtol=0.015)


def test_layers_of_one_medium_have_it_as_their_mean() -> None:
    medium = sss.materials.load("ketchup").medium
    mean = LayeredMedium.of((medium,) * 3, (0.1, 2.0)).mean()
    np.testing.assert_allclose(mean.sigma_s, medium.sigma_s, rtol=1e-9)
    np.testing.assert_allclose(mean.sigma_a, medium.sigma_a, rtol=1e-9)


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ("ketchup", "layers must be NAME THICKNESS"),
        ("ketchup, apple", "layers must have a thickness"),
        ("ketchup 0, apple", "finite and > 0"),
        ("ketchup 0.1, aple", "did you mean"),
        ("skin VII", "skin of the types I, II"),
        ("skin III 0.1, ketchup", "must be one of"),
    ],
)
def test_bad_layers_are_refused_by_name(layers: str, message: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=message):
        _scene(1.0, layers, type="translucent_walk")


def test_layers_of_different_indices_are_refused() -> None:
    media = (sss.Medium([1.0, 2.0], 0.1, eta=1.3), sss.Medium([1.0, 2.0], 0.1, eta=1.4))
    with pytest.raises(ValueError, match=r"one g and eta, got .* eta 1.4 of layer 2"):
        LayeredMedium.of(media, (0.1,))


def test_layers_and_another_medium_are_refused() -> None:
    with pytest.raises((ValueError, RuntimeError), match="layers must stand without sigma_t, material"):
        mi.load_dict({"type": "translucent", "layers": COLOURS, "material": "marble", "sigma_t": 1.0})
