"""Media by textures as `full_geometry` learns them: walks and S_0 of the medium of the exit, identity, images.

A z-test fails at 4 standard errors (two-sided 6e-5); seeds are fixed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

import full_geometry  # noqa: E402
from full_geometry.learning.model_errors import LIGHTS, transport_of  # noqa: E402
from full_geometry.learning.network_fitting import Recipe  # noqa: E402
from full_geometry.learning.training import Trained, train  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.scenes.scene_files import load_objects  # noqa: E402
from full_geometry.transport import storing  # noqa: E402
from full_geometry.transport.exit_pairs import trace_exits  # noqa: E402
from full_geometry.transport.one_object import HalfSpace  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

QUICK = Recipe(width=32, depth=2, batch=512, chunk=2**14, reuse=2)
CHUNKS, PASSES = 6, 6
PALE, DARK = ([0.98, 0.9, 0.7], [2.0, 3.0, 4.0]), ([0.5, 0.7, 0.95], [4.0, 3.0, 2.0])  # albedo, sigma_t


def cube(*media: tuple, **more) -> dict:
    """Each texel a half of every face."""
    texels = {
        name: {"type": "bitmap", "bitmap": mi.Bitmap(np.float32([values])), "raw": True, "filter_type": "nearest"}
        for name, values in zip(("albedo", "sigma_t"), zip(*media))
    }
    surface = {"type": "translucent", "model": "full_geometry", "orders": "multiple", "reflection": False, **texels}
    return {"type": "cube", "bsdf": {**surface, "g": 0.3, "eta": 1.4}, **more}


def scene(**shown) -> dict:
    view = mi.ScalarTransform4f().look_at([3, 4, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {
        "type": "scene", "integrator": {"type": "bssrdf", "hide_emitters": True, "light": "sampled"},
        "sensor": {"type": "perspective", "fov": 34.0, "to_world": view, "film": film},
        "lamp": {"type": "sphere", "center": [0, 7, 4], "radius": 3.0, "emitter": {"type": "area", "radiance": 3.0}},
        "sky": {"type": "constant", "radiance": 0.5}, **shown,
    }  # fmt: skip


def painted(*media: tuple, **more) -> TranslucentObject:
    return object_of(load_objects({"type": "scene", "integrator": {"type": "bssrdf"}, "cube": cube(*media, **more)}))


@pytest.fixture(scope="module")
def trained(folder: Path) -> Trained:
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    return train(painted(PALE, DARK), chunks=CHUNKS, recipe=QUICK, folder=folder)


def test_walks_from_points_have_the_medium_of_their_start_and_S_0_too() -> None:
    both, pale, dark = painted(PALE, DARK), painted(PALE, PALE), painted(DARK, DARK)
    rng = generator(mi, 2**16, pass_seed(1))
    exits, entries = (both.random_points(rng) for _ in range(2))
    first = np.isclose(np.array(exits.medium.sigma_t)[0], PALE[1][0])
    assert 0.45 < first.mean() < 0.55
    T = np.array(trace_exits(both, exits, (2,)).T)
    for obj, here in ((pale, first), (dark, ~first)):
        starts = obj.random_points(generator(mi, 2**16, pass_seed(1)))
        alone = np.array(trace_exits(obj, starts, (3,)).T)[:, here]
        error = np.hypot(*(v.std(axis=1) / np.sqrt(here.sum()) for v in (T[:, here], alone)))
        assert np.all(np.abs(T[:, here].mean(axis=1) - alone.mean(axis=1)) < 4 * error)
        assert np.all(np.abs(T[:, ~here].mean(axis=1) - alone.mean(axis=1)) > 8 * error)
        S = []
        for each in (both, obj):
            base = HalfSpace(each, "better_dipole", floor=0.0)
            known = starts.medium if each is obj else exits.medium
            S.append(np.array(base(*(base.end(at._replace(medium=known)) for at in (exits, entries))))[:, here])
        np.testing.assert_allclose(S[0], S[1], rtol=0.01, atol=1e-5 * S[1].max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "message"),
    [((DARK, PALE), "must be trained for full_geometry"), ((PALE, PALE), "must be trained for full_geometry")],
    ids=["exchanged", "one"],
)
def test_weights_of_other_textures_are_refused(trained: Trained, folder: Path, changed: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        storing.find_weights(painted(*changed), folder)


@pytest.mark.slow
def test_an_object_moved_with_its_textures_is_the_same_one(trained: Trained, folder: Path) -> None:
    turn = mi.ScalarTransform4f().translate([3, 0, 0]).rotate([0.6, 0.8, 0], 40)
    assert storing.find_weights(painted(PALE, DARK, to_world=turn), folder) == trained.path


def test_half_space_models_have_no_errors_of_textures() -> None:
    with pytest.raises(ValueError, match="must be without textures for errors of 'better_dipole'"):
        transport_of(painted(PALE, DARK), "better_dipole")


@pytest.mark.slow
def test_an_image_has_the_light_of_walks_within_the_stated_error(trained: Trained) -> None:
    """In quarters of the picture."""
    shown = mi.load_dict(scene(cube=cube(PALE, DARK)))
    walks = mi.load_dict({"type": "translucent_walk", "max_depth": -1, "hide_emitters": True})
    images = [
        np.array([mi.render(shown, integrator=how, spp=spp, seed=k) for k in range(PASSES)], dtype=float)
        for how, spp in ((shown.integrator(), 256), (walks, 512))
    ]
    quarters = [v.reshape(PASSES, 2, 8, 2, 8, 3).mean(axis=(2, 4)) for v in images]
    ratio = quarters[0].mean(axis=0) / quarters[1].mean(axis=0)
    errors = np.hypot(*(v.std(axis=0, ddof=1) / np.sqrt(PASSES) / v.mean(axis=0) for v in quarters))
    stated = np.array([row.error for row in trained.errors if row.light == LIGHTS[1]])
    assert np.all(np.abs(ratio - 1) < stated + 4 * errors), (ratio, stated, errors)
    assert np.all(stated < 0.2) and np.all(errors < 0.02)
