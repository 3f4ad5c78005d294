"""What the tests share: every test with the argument `name` runs once for each model of the one list."""

from __future__ import annotations

import csv
import functools
import gc
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # the tests run side by side: threads of each would only get in their way
    os.environ["OMP_NUM_THREADS"] = "1"

if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):  # every process that a test starts would compile all modules anew
    sys.dont_write_bytecode = False

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what runs in its background
    signal.signal(signal.SIGINT, signal.default_int_handler)

import numpy as np
import pytest
import quick_kernels
import quick_light
import typer.testing
from one_thread import work_in_one_thread

import halfspace_sss
from benchmarks.truths import TABLE
from halfspace_sss import backend
from halfspace_sss.comparison import reflectance_curves, style
from halfspace_sss.materials import catalogue as registry
from halfspace_sss.neural import material_model, paper_model, store
from halfspace_sss.neural.network import N_FEATURES, layer_shapes
from halfspace_sss.neural.store import save_weights

# by CPU time, of fast and slow tests: begun first, so that no worker is left with one of them at the end
LONGEST = (
    "test_page_commands", "test_fit", "test_instances", "test_every_emitter", "test_any_place_and_unit",
    "test_correction", "test_unscattered_light", "test_fig_full_geometry", "test_full_scenes", "test_edits",
    "test_endings", "test_gallery", "test_bench", "test_full_online", "test_flame", "test_rendering_gradients",
    "test_neural_reflectance", "test_full_training", "test_inside", "test_full_command", "test_trade_scenes",
    "test_gathered", "test_total_error", "test_full_varying", "test_full_contents", "test_full_textured",
    "test_translucent_walk", "test_neural_training", "test_rendering_kernels", "test_walk_gradients",
    "test_varying_media", "test_lit_entries", "test_gradient_blocks", "test_cli_train", "test_rendering_normals",
    "test_wrapped", "test_readme", "test_shape_model", "test_inner_light", "test_extremes", "test_low_orders",
    "test_model_contract", "test_fuzz",
)  # fmt: skip


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One more than cores, as tests wait for processes that they start; four at most: each takes up to 2 GB."""
    return max(2, min(backend.cores() + 1, 4))


def pytest_configure(config: pytest.Config) -> None:
    """Whole suites keep their kernels apart: they are compiled without LLVM's optional passes."""
    if config.option.markexpr in ("", "not slow", "slow"):
        quick_kernels.keep_apart()


def pytest_collection_finish() -> None:
    """Compile kernels in a quarter of the time, and look through no modules where garbage is collected."""
    if "drjit" in sys.modules:
        quick_kernels.compile_quickly()
    if "PYTEST_XDIST_WORKER" in os.environ and "mitsuba" in sys.modules:
        work_in_one_thread()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ranks = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path.stem, len(LONGEST)))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "name" in metafunc.fixturenames:
        metafunc.parametrize("name", halfspace_sss.models())


@pytest.fixture(scope="session", autouse=True)
def stand_ins(tmp_path_factory: pytest.TempPathFactory):
    """Random weights for media that nobody has trained: the contract holds for any weights, only accuracy does not."""
    folder = tmp_path_factory.mktemp("weights")
    inputs = {material_model.KIND: (N_FEATURES, 32), paper_model.KIND: (paper_model.N_INPUTS, 256)}

    def find(kind: str, medium: halfspace_sss.Medium) -> Path:
        path = folder / store.weights_name(kind, medium)
        if not path.exists():
            rng, arrays = np.random.default_rng(7), {}
            for k, shape in enumerate(layer_shapes(inputs[kind][0], inputs[kind][1], 3)):
                arrays[f"W_{k}"] = (rng.standard_normal(shape) / np.sqrt(shape[0])).astype(np.float32)
                arrays[f"b_{k}"] = (0.1 * rng.standard_normal(shape[1])).astype(np.float32)
            ratios = {key: float(getattr(medium, key)) for key in store.RATIOS}
            record = {"width": inputs[kind][1], "depth": 3, "scale": float(medium.albedo) ** 2, "medium": ratios}
            save_weights(path, kind, arrays, record)
        return path

    with pytest.MonkeyPatch.context() as patch:
        for module in (material_model, paper_model):
            patch.setattr(module, "find_weights", find)
        yield


@pytest.fixture(scope="module", autouse=True)
def no_traces_of_other_files() -> None:
    """Kernels call what is left of scenes of other tests too, such as textures without colour: they are freed.

    The variant of Mitsuba is that of most tests again, since fixtures of a module come before `rgb` of its tests.
    """
    if "mitsuba" in sys.modules:
        gc.collect()
        _set_variant("llvm_ad_rgb")


@pytest.fixture(scope="session", autouse=True)
def commands_made_once() -> Iterator[None]:
    """The command line is made from its functions once, and not for each line that a test enters."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.testing, "_get_command", functools.cache(typer.testing._get_command))
        yield


@pytest.fixture(scope="session", autouse=True)
def speeds_are_measured_shortly() -> Iterator[None]:
    """Of models in a set of curves, for a hundredth of a second each in place of a tenth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reflectance_curves.evaluations_per_s, "__defaults__", (4096, 0.01))
        yield


@pytest.fixture(scope="session", autouse=True)
def figures_are_drawn_coarsely() -> Iterator[None]:
    """At 60 dots an inch in place of 300, a fraction of the pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style.saved, "__defaults__", (60,))
        yield


@pytest.fixture(scope="session")
def truths() -> list[dict[str, str]]:
    """Rows of the reference values."""
    text = TABLE.read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


def _set_variant(name: str) -> None:
    import mitsuba as mi

    import full_geometry

    mi.set_variant(name)
    full_geometry.register()
    for load in ("load_dict", "load_file", "load_string"):
        if not isinstance(getattr(mi, load), functools.partial):
            # several threads number the shapes by chance: other kernels would be compiled for the same scene
            setattr(mi, load, functools.partial(getattr(mi, load), parallel=False))


@pytest.fixture
def rgb() -> None:
    """Our plugins under the variant llvm_ad_rgb of Mitsuba."""
    _set_variant("llvm_ad_rgb")


@pytest.fixture
def mono() -> None:
    """Our plugins under the variant llvm_ad_mono of Mitsuba."""
    _set_variant("llvm_ad_mono")


@pytest.fixture
def spectral() -> None:
    """Our plugins under the variant llvm_ad_spectral of Mitsuba."""
    _set_variant("llvm_ad_spectral")


@pytest.fixture
def quiet_rgb(rgb: None):
    """As `rgb`, without warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.fixture
def little_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light is gathered, corrected and precomputed by few samples."""
    quick_light.gather_by_few(monkeypatch.setattr)


@pytest.fixture
def queries():
    """`queries(n, medium)`: r in mm (1e-3 to 30 mean free paths), mu_i, phi_i, mu_o, phi_o, the same on every call."""

    def make(n: int, medium: halfspace_sss.Medium, seed: int = 20240703) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        r = 10 ** rng.uniform(-3, 1.5, n) / np.min(medium.sigma_t)
        mu_i, mu_o = rng.uniform(0.02, 1, (2, n))
        phi_i, phi_o = rng.uniform(-np.pi, np.pi, (2, n))
        return [r, mu_i, phi_i, mu_o, phi_o]

    return make


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """A registry of its own, with no files of the user and no entry points, as the one behind the public functions."""
    monkeypatch.delenv(registry.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "config"))
    monkeypatch.setattr(registry, "entry_points", lambda group: [])
    monkeypatch.setattr(registry, "_registry", registry.Registry())
    return registry


@pytest.fixture
def written(tmp_path):
    """`written(text, name)`: the path of a file with that text."""

    def write(text: str, name: str = "mine.toml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return write
