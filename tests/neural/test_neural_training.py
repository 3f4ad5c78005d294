"""Training: it learns, repeats bit for bit, survives being killed, refuses the work of others, and is found again."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import halfspace_sss
from benchmarks.universal_training import Hyper, UniversalRecipe, draw_media, train_universal
from halfspace_sss import Medium, materials
from halfspace_sss.comparison.model_errors import ReferenceSize, TracedMaps, model_error, reference_maps
from halfspace_sss.maps.noisy_maps import CellGrid, draw_directions, make_pool
from halfspace_sss.neural.training.fit import Fit, Source, fit
from halfspace_sss.neural.training.learners import MapPool, PaperLearner, Small
from halfspace_sss.neural.training.train_material import (
    MaterialRecipe,
    MaterialTraining,
    PaperTraining,
    TrainedChannel,
    Trial,
    train,
    train_channel,
)
from halfspace_sss.neural.universal import Hypernetwork
from halfspace_sss.progress import NamedProgress

FIG10 = materials.load("fig10").medium
HOW = Fit(steps=100, n_groups=8, n_queries=64, checkpoint_every=0.0, validate_every=50)
GRID = CellGrid(8, 4)
RECIPE = MaterialRecipe(n_groups=272, events=2e5, grid=GRID, how=HOW)  # more groups than one launch traces
UNIVERSAL = UniversalRecipe(272, 2e5, GRID, HOW, rank=4, calibration_media=8, calibration_how=Fit(20, n_groups=8))


def run_channel(work: Path, progress: NamedProgress | None = None) -> Path:
    """Weights of a training of Fig. 10 that goes on with what is in `work`."""
    return train_channel(
        FIG10, MaterialTraining(), RECIPE, 3, folder=work / "weights", work=work / "work", progress=progress
    ).path


def run_universal(work: Path, progress: NamedProgress | None = None) -> Path:
    """Weights of a training of the universal network that goes on with what is in `work`."""
    return train_universal(work, 3, UNIVERSAL, progress=progress)


RUNS = {"channel": run_channel, "universal": run_universal}


@pytest.fixture(scope="module")
def fig10(tmp_path_factory: Any) -> TrainedChannel:
    """Fig. 10 trained in one go."""
    (result,) = train("fig10", recipe=RECIPE, seed=3, folder=tmp_path_factory.mktemp("fig10"))
    return result


@pytest.fixture(scope="module")
def pool() -> MapPool:
    rng = np.random.default_rng(1)
    one = np.ones(64)
    groups = draw_directions(0.75 * one, 0.0 * one, 1.3 * one, rng)
    return MapPool(groups, GRID, make_pool(groups, GRID, 1e6, (1,)))


@pytest.fixture(scope="module")
def reference() -> TracedMaps:
    return reference_maps([FIG10], ReferenceSize(1, GRID, 2), 1e6, (2,))[0]


def _batches(pool: MapPool) -> Source:
    return pool.batches(HOW.n_groups, HOW.n_queries)


@pytest.mark.slow
def test_a_trained_network_beats_its_untrained_start(pool: MapPool, reference: TracedMaps) -> None:
    training = MaterialTraining(warm=False)
    learner = training.learner(reference.medium, pool, 0)
    before = model_error(training.model(reference.medium, learner), reference).error
    fit(learner, _batches(pool), replace(HOW, steps=150), 0)
    assert model_error(training.model(reference.medium, learner), reference).error < 0.5 * before


def test_a_trained_network_of_the_paper_beats_its_untrained_start_by_its_own_loss(pool: MapPool) -> None:
    learner = PaperLearner(FIG10.in_mfp(), PaperTraining().learner(FIG10.in_mfp(), pool, 0).scale, width=32)
    batch = pool.batch(64, 256, torch.Generator().manual_seed(1))
    before = float(learner.loss(batch).detach())
    fit(learner, _batches(pool), replace(HOW, steps=150), 0)
    assert float(learner.loss(batch).detach()) < 0.8 * before


def test_a_trained_universal_network_beats_its_untrained_start(reference: TracedMaps) -> None:
    def error(learner: Hyper) -> float:
        arrays = learner.parameters_as_arrays()
        layers = tuple((arrays[f"medium_{k}_W"], arrays[f"medium_{k}_b"]) for k in range(3))
        network = Hypernetwork(layers, arrays["base"], arrays["basis"], learner.width, learner.depth)
        return model_error(Trial(reference.medium, network.network(0.75, 0.0, 1.3)), reference).error

    rng = np.random.default_rng(1)
    groups = draw_directions(*draw_media(64, rng), rng)
    learner = Hyper(rank=4)
    before = error(learner)
    fit(learner, _batches(MapPool(groups, GRID, make_pool(groups, GRID, 1e6, (1,)))), replace(HOW, steps=150), 0)
    assert error(learner) < 0.5 * before


@pytest.mark.slow
def test_the_same_seed_gives_the_same_weights(fig10: TrainedChannel, tmp_path: Path) -> None:
    (again,) = train(FIG10, recipe=RECIPE, seed=3, folder=tmp_path)
    assert again.path.read_bytes() == fig10.path.read_bytes() and again.error == fig10.error


@pytest.mark.slow
def test_another_seed_gives_other_weights(fig10: TrainedChannel, tmp_path: Path) -> None:
    (other,) = train(FIG10, recipe=RECIPE, seed=4, folder=tmp_path)
    assert other.path.read_bytes() != fig10.path.read_bytes()


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_neural_training import run_channel

work = Path(sys.argv[2])
for when in ("data", "training"):
    def kill(doing, done, total):
        if doing == when:
            assert done < total
            os.kill(os.getpid(), signal.SIGKILL)

    child = os.fork()
    if not child:
        run_channel(work, kill)
        os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    print(len(list(work.rglob("maps-*.npy"))), len(list(work.rglob("checkpoint.safetensors"))))
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: Any) -> Path:
    """What is left of runs that were killed after one of two launches of maps, and again after 50 of 100 steps."""
    work = tmp_path_factory.mktemp("killed")
    command = [sys.executable, "-c", KILLED, str(Path(__file__).parent), str(work)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0 and run.stdout.split("\n") == ["1 0", "2 1", ""], run.stderr
    return work


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system with fork and SIGKILL")
def test_a_run_that_was_killed_twice_ends_with_the_same_weights(
    killed: Path, fig10: TrainedChannel, monkeypatch: Any
) -> None:
    """Of a material; the universal network is trained by the same steps."""
    assert not list(killed.rglob("neural*"))
    steps, batch = [], MapPool.batch
    monkeypatch.setattr(MapPool, "batch", lambda *a: steps.append(1) or batch(*a))
    assert run_channel(killed).read_bytes() == fig10.path.read_bytes()
    assert len(steps) == 51  # the checkpoint of step 49 was found


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: Any) -> dict[str, Path]:
    """What trainings left when they were interrupted after the first launch of maps."""
    works = {what: tmp_path_factory.mktemp(what) for what in RUNS}
    for what, work in works.items():
        with pytest.raises(KeyboardInterrupt):
            RUNS[what](work, _interrupt)
    return works


def _other(what: str, work: Path, change: dict[str, Any]) -> None:
    arguments = {"medium": FIG10, "training": MaterialTraining(), "seed": 3, **change}
    recipe = replace(UNIVERSAL if what == "universal" else RECIPE, **arguments.pop("recipe", {}))
    if what == "universal":
        train_universal(work, arguments["seed"], recipe)
    else:
        train_channel(recipe=recipe, folder=work / "weights", work=work / "work", **arguments)


SHARED = [({"seed": 4}, "seed"), ({"recipe": {"events": 6e5}}, "recipe.events"),
          ({"recipe": {"how": replace(HOW, steps=101)}}, "recipe.how.steps"),
          ({"recipe": {"grid": CellGrid(8, 6)}}, "recipe.grid.n_psi")]  # fmt: skip
OWN = {
    "channel": [({"medium": Medium.from_albedo(0.75, 1.0, 0.01, 1.3)}, "medium.g"),
                ({"training": PaperTraining()}, "training.model"),
                ({"training": MaterialTraining(warm=False)}, "training.warm")],
    "universal": [({"recipe": {"rank": 5}}, "recipe.rank")],
}  # fmt: skip


@pytest.mark.parametrize(
    ("what", "change", "key"),
    [pytest.param(what, *case, id=f"{what}-{case[1]}") for what in RUNS for case in SHARED + OWN[what]],
)
def test_the_work_of_another_run_is_refused(interrupted: Any, what: str, change: dict, key: str) -> None:
    work = interrupted[what]
    before = {path: path.read_bytes() for path in work.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=rf"run.json: {key} must be .*, got .*; name another folder"):
        _other(what, work, change)
    assert {path: path.read_bytes() for path in work.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("what", RUNS)
def test_the_work_of_another_version_is_refused(interrupted: Any, monkeypatch: Any, what: str) -> None:
    monkeypatch.setattr(halfspace_sss, "__version__", "99")
    with pytest.raises(ValueError, match="run.json: version must be '99' to go on with this work, got"):
        RUNS[what](interrupted[what])


@pytest.mark.parametrize("left", ["checkpoint.safetensors", "maps-3-1-00000.npy"])
def test_work_of_which_nothing_is_known_is_refused(tmp_path: Path, left: str) -> None:
    (tmp_path / left).write_bytes(b"")
    with pytest.raises(ValueError, match=rf"{tmp_path}: work must come from a known run, got {left} without run.json"):
        run_universal(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{"])
def test_a_damaged_note_of_the_run_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(ValueError, match=f"{tmp_path / 'run.json'}: must be a"):
        run_universal(tmp_path)


@pytest.mark.parametrize("what", RUNS)
@pytest.mark.parametrize("damage", [lambda b: b[:-9], lambda b: b[:5], lambda b: b"", lambda b: b"no map" * 99])
def test_a_damaged_file_of_maps_is_refused(interrupted: Any, what: str, damage: Callable[[bytes], bytes]) -> None:
    (file,) = interrupted[what].rglob("maps-*.npy")
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    try:
        with pytest.raises(ValueError, match=f"{file}: maps cannot be used, remove the file"):
            RUNS[what](interrupted[what])
    finally:
        file.write_bytes(whole)


def _altered(data: bytes) -> bytes:
    return data[:-5] + bytes([data[-5] ^ 1]) + data[-4:]


@pytest.mark.parametrize("damage", [lambda b: b[:-9], lambda b: b[:5], lambda b: b"", _altered])
def test_a_damaged_checkpoint_is_refused(pool: MapPool, tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    file = tmp_path / "c.safetensors"
    how = replace(HOW, steps=2)
    fit(Small(width=4), _batches(pool), how, 0, checkpoint=file)
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ValueError, match=f"{file}: checkpoint cannot be used, remove it to start anew"):
        fit(Small(width=4), _batches(pool), how, 0, checkpoint=file)


def test_a_checkpoint_of_another_architecture_is_refused(pool: MapPool, tmp_path: Path) -> None:
    file = tmp_path / "c.safetensors"
    fit(Small(width=4), _batches(pool), replace(HOW, steps=2), 0, checkpoint=file)
    with pytest.raises(ValueError, match=f"{file}: checkpoint cannot be used.*shape"):
        fit(Small(width=5), _batches(pool), replace(HOW, steps=2), 0, checkpoint=file)


def test_training_stops_at_the_target_error(pool: MapPool, tmp_path: Path) -> None:
    errors, how = iter([0.5, 0.21, 0.2, 0.1]), replace(HOW, validate_every=10)
    arguments = {"checkpoint": tmp_path / "c.safetensors", "target_error": 0.2}
    history, _ = fit(Small(width=4), _batches(pool), how, 0, validate=lambda: next(errors), **arguments)
    assert [(h["step"], h["error"]) for h in history] == [(10, 0.5), (20, 0.21), (30, 0.2)]
    assert fit(Small(width=4), _batches(pool), how, 0, validate=lambda: next(errors), **arguments).history == history


def test_training_that_stopped_goes_on_towards_a_smaller_target(pool: MapPool, tmp_path: Path) -> None:
    how, file = replace(HOW, validate_every=10), tmp_path / "c.safetensors"
    fit(Small(width=4), _batches(pool), how, 0, checkpoint=file, validate=lambda: 0.2, target_error=0.2)
    history, _ = fit(Small(width=4), _batches(pool), how, 0, checkpoint=file, validate=lambda: 0.1, target_error=0.1)
    assert [(h["step"], h["error"]) for h in history] == [(10, 0.2), (20, 0.1)]
