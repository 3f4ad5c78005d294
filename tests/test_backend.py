"""An LLVM that would abort the process is refused by a sentence before anything is compiled.

The LLVM that Dr.Jit says it has loaded is faked; where an old one lies in the system the same is tried with it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from halfspace_sss import backend

OLD = "import drjit as dr\ndr.detail.llvm_version = lambda: (15, 0, 7)\n"
REFUSED = "Dr.Jit found LLVM 15.0.7 when it was imported, but it needs LLVM 17 or newer: import halfspace_sss"
REGISTER = "import mitsuba as mi\nmi.set_variant('llvm_ad_rgb')\nimport full_geometry\nfull_geometry.register()"
QUERY = "1.0, 0.9, 0.0, 0.8, 0.5"
USES = {
    "register": REGISTER,
    "set_variant after register": (
        "import mitsuba as mi\nimport full_geometry as r\nfrom full_geometry import plugins\n"
        "mi.set_variant('scalar_rgb')\nmi.detail.add_variant_callback(plugins._on_variant)\n"
        "mi.set_variant('llvm_ad_rgb')"
    ),
    "eval": (
        "import halfspace_sss as h\nfrom drjit.llvm import Float\n"
        "h.bssrdf('neural', h.Medium(1.0, 0.1)).eval(Float(1.0), 0.9, 0.0, 0.8, 0.5)"
    ),
    "differentiable eval": (
        "import halfspace_sss as h\nfrom drjit.llvm.ad import Float\n"
        "h.bssrdf('standard_dipole', h.Medium(1.0, 0.1)).eval(Float(1.0), 0.9, 0.0, 0.8, 0.5)"
    ),
    "sample": (
        "import halfspace_sss as h\nfrom drjit.llvm import Float\n"
        "h.bssrdf('neural', h.Medium(1.0, 0.1)).sample_position(Float(0.9), (Float(0.5), Float(0.5)))"
    ),
    "fresnel": "from halfspace_sss.physics.fresnel import F_r\nfrom drjit.llvm import Float\nF_r(Float(0.5), 1.3)",
    "trace": "import halfspace_sss as h\nh.trace(h.Medium(1.0, 0.1), 1.0, 1000)",
}


def run(code: str, **environment: str) -> str:
    """The last line that a fresh process says; it must fail by an exception, not by an abort."""
    env = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"} | environment
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=120)
    assert found.returncode == 1, found
    return found.stderr.strip().splitlines()[-1]


@pytest.mark.parametrize("use", USES)
def test_an_old_llvm_that_drjit_has_loaded_is_refused_before_use(use: str) -> None:
    if "mitsuba" in USES[use]:
        pytest.importorskip("mitsuba")
    assert run(OLD + USES[use]).startswith(f"halfspace_sss.backend.BackendError: {REFUSED}")


def test_an_old_llvm_is_warned_of_when_the_package_is_imported_after_drjit() -> None:
    """As Mitsuba loads scenes, and aborts, before `register` is called."""
    for imported in ("halfspace_sss", "full_geometry"):
        code = f"{OLD}import {imported}"
        found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
        assert found.returncode == 0 and f"UserWarning: LLVM would abort this process: {REFUSED}" in found.stderr


def test_no_llvm_at_all_is_refused_in_the_same_way() -> None:
    line = run("import drjit as dr\ndr.detail.llvm_version = lambda: (-1, -1, -1)\n" + USES["eval"])
    assert "Dr.Jit found no LLVM that it takes when it was imported, but it needs LLVM 17 or newer" in line


def test_a_path_that_the_user_set_is_named_where_it_is_at_fault(tmp_path: Path) -> None:
    wrong = tmp_path / "libLLVM.so"
    wrong.write_bytes(b"no library")
    code = f"{OLD}import os\nos.environ['DRJIT_LIBLLVM_PATH'] = {str(wrong)!r}\n{USES['eval']}"
    assert f"unset DRJIT_LIBLLVM_PATH = {wrong}, or" in run(code)


def test_arrays_of_other_libraries_need_no_llvm() -> None:
    code = f"{OLD}import halfspace_sss as h\nassert h.bssrdf('neural', h.Medium(1.0, 0.1)).eval({QUERY}) > 0"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr


def _old_of_the_system() -> list[str]:
    """The libraries of old versions that are installed."""
    return [path for path in backend._candidates() if backend._llvm_version(path) in range(backend.OLDEST_LLVM)]


@pytest.mark.skipif(not _old_of_the_system(), reason="no LLVM older than 17 in this system")
@pytest.mark.parametrize("use", ["register", "eval"])
def test_an_old_llvm_of_the_system_does_not_abort(use: str) -> None:
    if use == "register":
        pytest.importorskip("mitsuba")
    for path in {os.path.realpath(path) for path in _old_of_the_system()}:
        line = run(f"import drjit\n{USES[use]}", DRJIT_LIBLLVM_PATH=path)
        own = "the LLVM backend is inactive" in line  # with 14 Dr.Jit itself makes neither arrays nor a variant
        assert own or f"but it needs LLVM 17 or newer: unset DRJIT_LIBLLVM_PATH = {path}" in line


@pytest.mark.skipif(not _old_of_the_system(), reason="no LLVM older than 17 in this system")
def test_an_old_llvm_that_the_user_set_is_told_from_a_damaged_one() -> None:
    line = run(USES["trace"], DRJIT_LIBLLVM_PATH=_old_of_the_system()[0])
    assert "DRJIT_LIBLLVM_PATH = " in line and " is LLVM " in line


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen here")
@pytest.mark.parametrize(
    "use",
    [
        "import full_geometry\nfull_geometry.register()\nimport mitsuba as mi\n"
        "mi.Bitmap(image).write('a.exr')\nassert np.array_equal(np.array(mi.Bitmap('a.exr')), image)",
        "from figures.parts.runner import exr_bytes, read_exr\n"
        "open('a.exr', 'wb').write(exr_bytes(image, 'a', 'test'))\nassert np.array_equal(read_exr('a.exr'), image)",
    ],
    ids=["rendering", "figures"],
)
def test_a_machine_with_one_core_writes_and_reads_images(use: str, tmp_path: Path) -> None:
    code = (
        "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nimport numpy as np\nimport halfspace_sss\n"
        "from halfspace_sss.backend import busy_threads, prepare_llvm\nprepare_llvm()\nimport mitsuba as mi\n"
        f"mi.set_variant('llvm_ad_rgb')\nimage = np.ones((300, 300, 3), np.float32)\n{use}\nassert busy_threads() == 1"
    )
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path}
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=env, cwd=tmp_path, timeout=60
    )
    assert found.returncode == 0, found.stderr


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="cores cannot be told here")
@pytest.mark.parametrize(
    "quota, most", [("150000 100000", 1), ("50000 100000", 1), ("900000000 100000", None), ("max 100000", None)]
)
def test_cores_are_those_that_the_control_group_allows(
    quota: str, most: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "Path", lambda path: SimpleNamespace(read_text=lambda encoding: quota))
    assert backend.cores() == (most or len(os.sched_getaffinity(0)))


def test_kernels_are_kept_where_the_environment_says(tmp_path: Path) -> None:
    code = (
        "import halfspace_sss\nfrom halfspace_sss.backend import array_types\nF = array_types().Float\n"
        "print((F([1, 2]) * 3 + 0.12345)[1])"
    )
    env = {**os.environ, "DRJIT_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=env, timeout=60)
    assert list(tmp_path.glob("*.bin"))


def _flags() -> set[str]:
    """What the CPU says that it has, on Linux."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="ascii").splitlines() if path.exists() else []
    return {flag for line in lines if line.startswith("flags") for flag in line.split(":")[1].split()}


@pytest.mark.skipif("avx2" not in _flags() or "avx512f" in _flags(), reason="not a CPU with AVX2 alone")
@pytest.mark.parametrize("use", [REGISTER, "from halfspace_sss.backend import array_types\narray_types()"])
def test_lanes_gather_at_once_and_those_that_are_masked_read_nothing(use: str) -> None:
    code = (
        f"import halfspace_sss\n{use}\nimport drjit as dr\nfrom drjit.llvm import Float, UInt32\n"
        "values, place = dr.arange(Float, 10), dr.opaque(UInt32, 0, 9) + dr.arange(UInt32, 9)\n"
        "dr.set_flag(dr.JitFlag.PrintIR, True)\n"
        "found = dr.gather(Float, values, dr.select(place == 3, 2**30, place + 1), place != 3)\n"
        "print([int(x) for x in found])"
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    assert "+fast-gather" in found.stdout + found.stderr
    assert found.stdout.strip().splitlines()[-1] == "[1, 2, 3, 0, 5, 6, 7, 8, 9]"
