"""What an object is under the same light from everywhere, learnt beside S: its error, its file, its images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from halfspace_sss import Medium

mi = pytest.importorskip("mitsuba")
torch = pytest.importorskip("torch")

from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.fitting import ALPHA_HIDDEN, Recipe  # noqa: E402
from full_geometry.learning.model_errors import EVEN_SKY, LIGHTS, errors_of  # noqa: E402
from full_geometry.learning.training import (  # noqa: E402
    Trained,
    train,
    trusted,  # noqa: E402
)
from full_geometry.models import storing  # noqa: E402
from full_geometry.models.object_model import BOUND  # noqa: E402
from full_geometry.object.features import Quadratic, n_side  # noqa: E402
from full_geometry.object.first_event import first_event  # noqa: E402
from full_geometry.object.radiance import reference  # noqa: E402
from full_geometry.object.subject import Subject  # noqa: E402
from full_geometry.object.walks import trace_exits  # noqa: E402
from full_geometry.scene import LearntTransport  # noqa: E402
from halfspace_sss import rendering  # noqa: E402
from halfspace_sss.neural import trained as known_weights  # noqa: E402
from halfspace_sss.neural.store import load_weights, save_weights  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
QUICK = Recipe(width=32, depth=2, batch=1024, chunk=2**15, reuse=4)
WAX = Medium(np.array([0.95, 0.0, 0.6]), np.array([0.05, 0.2, 0.4]), 0.0, 1.4)
SURFACE = {"type": "translucent", "sigma_s": "0.95,0,0.6", "sigma_a": "0.05,0.2,0.4", "eta": 1.4}


@pytest.fixture(autouse=True)
def variant() -> None:
    mi.set_variant("llvm_ad_rgb")
    rendering.register()


def shape(**more) -> dict:
    """About 4 mean free paths across; G does not scatter."""
    at = mi.ScalarTransform4f().scale(0.4)
    return {"type": "ply", "filename": str(BUNNY), "to_world": at, **more}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory):
    mi.set_variant("llvm_ad_rgb")
    rendering.register()
    folder = tmp_path_factory.mktemp("weights")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(known_weights.ENVIRONMENT_VARIABLE, str(folder))
        yield train(mi.load_dict(shape()), WAX, chunks=12, recipe=QUICK, folder=folder)


def test_orders_below_two_and_the_others_agree_with_walks(trained: Trained) -> None:
    subject, n = trained.model.subject, 2**19
    at = subject.random_points(generator(mi, n, pass_seed(3)))
    T = [trace_exits(subject, at, (4,), fewest=fewest).T for fewest in (0, 2)]
    few, more = (np.array(v) for v in trained.model.alpha(at))
    walked = np.array(T[0] - T[1]), np.array(T[1])
    for learnt, walk in zip((few, more), walked):
        error = (learnt - walk).std(axis=1) / np.sqrt(n)
        assert np.all(np.abs((learnt - walk).mean(axis=1)) <= 4 * error + 0.01 * walk.mean(axis=1))
    P = np.array(first_event(subject, at).P)
    assert np.all(more[1] == 0) and np.all(more >= 0) and np.all(more <= P + 1e-5)


def test_S_of_training_and_of_images_know_the_same_of_even_light(trained: Trained) -> None:
    subject, n = trained.model.subject, 4096
    run = training._Run(subject, QUICK, 0, None, None)
    networks, generator_ = run.fitting.average, torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in networks.parameters():
            p.normal_(std=0.2, generator=generator_)
    arrays = run.arrays()
    arrays[storing.ENDS] = 0.01 * np.random.default_rng(2).standard_normal(arrays[storing.ENDS].shape)
    model = storing.assemble(subject, run.frame, run.start, arrays).model
    rng = generator(mi, n, pass_seed(6))
    exits, entries = subject.random_points(rng), subject.random_points(rng)
    pairs = run.source._columns(exits, entries, mi.Float(1) + 0 * entries.p.x)
    with torch.no_grad():
        joined = networks["alpha"].joined(torch.from_numpy(pairs.features))
        g = BOUND * np.arctanh(networks["S"](joined).numpy() / BOUND)
    ends = [[mi.Float(v) for v in side] for side in np.split(pairs.features[: 2 * n_side(3)], 2)]
    h = sum(np.array([v.numpy() for v in Quadratic(arrays[storing.ENDS], n_side(3))(side)]) for side in ends)
    f = BOUND * np.tanh((g + h) / BOUND)
    assert h.std() > 0.02 and f.std() > 0.1 and len(joined) == len(pairs.features) + 2 * ALPHA_HIDDEN[-1]
    S = np.array(model.S(model.prepare(exits), entries))
    assert np.allclose(S, pairs.values * np.exp(f), rtol=0.02, atol=1e-4 * S.max())  # weights in half precision


MISSING = [
    (storing.EVEN, "even light must be learnt"),
    (storing.TURNS, "turns of"),
    (storing.ENDS, "functions of ends"),
]


@pytest.mark.parametrize("missing, what", MISSING)
def test_weights_of_before_it_was_known_are_refused_by_name(
    trained: Trained, missing: str, what: str, tmp_path: Path
) -> None:
    arrays, record = load_weights(trained.path, storing.KIND)
    path = tmp_path / trained.path.name
    save_weights(path, storing.KIND, {k: v for k, v in arrays.items() if k != missing}, record)
    subject = Subject.of(mi.load_dict(shape()), WAX)
    with pytest.raises(ValueError, match=f"{what}.*to be trained again"):
        storing.find_weights(subject, tmp_path)
    with pytest.raises(ValueError, match="to be trained again"):
        storing.load(path, subject)


def test_only_what_is_wrong_in_a_channel_is_left_to_other_estimates(trained: Trained) -> None:
    model, alpha = trained.model, trained.model.alpha
    truth = reference(model.subject, 128, 512, 5)

    def judged(order: int, channel: int) -> np.ndarray:
        last = f"a_{len(alpha.weights) // 2 - 1}"
        bias = alpha.weights[last].copy()
        bias[3 * order + channel] += 1.0
        wrong = replace(alpha, weights={**alpha.weights, last: bias})
        found = trusted(replace(model, alpha=wrong), truth, trained.errors, 512, (6,))
        few, more = (np.array(v) for v in replace(wrong, trusted=found)(truth.exits))
        assert np.all((few > 0).any(axis=1) == (found[0] > 0)) and np.all(more[found[1] == 0] == 0)
        return found

    assert judged(0, 2).tolist() == [[1, 1, 0], [1, 1, 1]]
    assert judged(1, 0).tolist() == [[1, 1, 1], [0, 1, 1]]


def test_errors_of_images_of_an_even_sky_are_those_of_alpha_where_it_is_trusted_and_of_S_elsewhere(
    trained: Trained,
) -> None:
    model = trained.model

    def rows(known: list[float]) -> dict[str, list[tuple]]:
        alpha = replace(model.alpha, trusted=np.array([[1.0, 1.0, 1.0], known]))
        found = errors_of(model.subject, {"it": replace(model, alpha=alpha)}, exits=64, walks=1024, samples=512)["it"]
        return {kind: [row[2:] for row in found if row.light == kind] for kind in (EVEN_SKY, *LIGHTS)}

    by_alpha, by_S = rows([1.0, 0.0, 1.0]), rows([0.0, 0.0, 0.0])
    assert by_S[EVEN_SKY] == by_S["constant"] == by_alpha["constant"]
    changed = [a != b for a, b in zip(by_alpha[EVEN_SKY], by_S[EVEN_SKY])]
    assert changed == [True, False, True]
    assert all(abs(by_alpha[EVEN_SKY][c][0] - by_S[EVEN_SKY][c][0]) < 0.1 for c in (0, 2))


def test_an_even_sky_has_the_same_light_and_a_fifth_of_the_variance(
    trained: Trained, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = mi.ScalarTransform4f().look_at([0, 2, 9], [-0.2, 1.9, 0], [0, 1, 0]).scale(1.0)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    surface = {**SURFACE, "model": "full_geometry"}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "bssrdf", "train_seconds": 0.0}, "sky": {"type": "constant"},
        "bunny": shape(bsdf=surface), "sensor": {"type": "orthographic", "to_world": view, "film": film},
    })  # fmt: skip
    means, variances = [], []
    for knows in (True, False):
        if not knows:
            monkeypatch.delattr(LearntTransport, "alpha")
        runs = np.array([np.array(mi.render(scene, spp=32, seed=k)) for k in range(8)])
        means.append(runs.mean(axis=(0, 1, 2)))
        variances.append(runs.var(axis=0, ddof=1).mean())
    error = np.sqrt(sum(variances) / 8) / 16
    worst = max(row.error for row in trained.errors if row.light == LIGHTS[0])
    assert np.all(np.abs(means[0] - means[1]) < 4 * error + worst * means[1])
    assert variances[0] < 0.2 * variances[1]
