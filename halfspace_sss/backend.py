"""Which Dr.Jit backend runs: LLVM on a CPU, CUDA on a GPU; finds a usable LLVM before drjit is imported."""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from halfspace_sss.lazy import once

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

BACKENDS = ("llvm", "cuda")
OLDEST_LLVM = 17  # 14 and 15 abort the process ("Cannot select: fminimum")


class BackendError(RuntimeError):
    """No usable Dr.Jit backend on this machine."""


def needed(module: str, what: str, extra: str) -> ModuleType:
    """A module that comes with an extra of this package; BackendError says what needs it, and how it is installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise BackendError(f'{what}: pip install "halfspace-sss[{extra}]"') from error


def _llvm_version(path: str) -> int | None:
    """Major version of an LLVM library, 0 for those before 16, which do not tell, None if it cannot be loaded."""
    try:
        library = ctypes.CDLL(path)
    except OSError:
        return None
    major, minor, patch = (ctypes.c_uint() for _ in range(3))
    try:
        library.LLVMGetVersion(*(ctypes.byref(v) for v in (major, minor, patch)))
    except AttributeError:
        return 0
    return major.value


def _candidates() -> list[str]:
    """LLVM libraries that came with pip, then those of the system, newest name first."""
    patterns = ("libLLVM.so*", "libLLVM-*.so*", "libLLVM*.dylib", "LLVM-C.dll")
    system = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib")
    roots = [Path(sys.prefix) / "lib", *map(Path, system), Path("/opt/homebrew/opt/llvm/lib")]
    roots += sorted(Path("/usr/lib").glob("llvm-*/lib"), reverse=True)
    return [str(p) for root in roots for pattern in patterns for p in sorted(root.glob(pattern), reverse=True)]


def prefer_bundled_llvm() -> None:
    """Point Dr.Jit at the LLVM that pip installed, unless the user set one; called when the package is imported.
    Dr.Jit loads LLVM while it is imported itself and keeps it: what is set later has no effect. One that would abort
    the process is warned of then, as scenes may be loaded before this package is asked for anything."""
    if "drjit" in sys.modules:
        import drjit as dr

        version = dr.detail.llvm_version()
        if version is not None and 0 <= version[0] < OLDEST_LLVM:
            warnings.warn(f"LLVM would abort this process: {_told_of_loaded(version)}", stacklevel=3)
        return
    bundled = sorted((Path(sys.prefix) / "lib").glob("libLLVM.so*"))
    if bundled:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(bundled[0]))


def _told_of_loaded(version: tuple[int, int, int] | None) -> str:
    """A sentence on the LLVM that Dr.Jit has loaded, which is too old, and what helps."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    result = "no LLVM that it takes" if version is None or version[0] < 0 else "LLVM " + ".".join(map(str, version))
    remedy = "import halfspace_sss before drjit and mitsuba (`pip install karellen-llvm-core` brings an LLVM along)"
    if given and (_llvm_version(given) or 0) < OLDEST_LLVM:
        remedy = f"unset DRJIT_LIBLLVM_PATH = {given}"
    return (
        f"Dr.Jit found {result} when it was imported, but it needs LLVM {OLDEST_LLVM} or newer: {remedy}, "
        "or set DRJIT_LIBLLVM_PATH before Python starts"
    )


@once
def prepare_llvm() -> None:
    """See to it that Dr.Jit uses an LLVM that works; a path that the user set is kept.
    BackendError if none is found, the one the user set is too old or cannot be loaded, or Dr.Jit was imported before
    with an old one, which would abort the process."""
    if "drjit" in sys.modules:  # whichever LLVM it has loaded is the one that will compile
        import drjit as dr

        loaded = dr.detail.llvm_version()
        if loaded is None or loaded[0] < OLDEST_LLVM:
            raise BackendError(_told_of_loaded(loaded))
        return
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        version = _llvm_version(given)
        if version is None or version < OLDEST_LLVM:
            result = "cannot be loaded" if version is None else f"is LLVM {version or 'before 16'}"
            raise BackendError(
                f"DRJIT_LIBLLVM_PATH = {given} {result}; Dr.Jit needs LLVM {OLDEST_LLVM} or newer: "
                "unset it, or `pip install karellen-llvm-core`"
            )
        return
    for path in _candidates():
        version = _llvm_version(path)
        if version is not None and version >= OLDEST_LLVM:
            os.environ["DRJIT_LIBLLVM_PATH"] = path
            return
    raise BackendError(
        f"no LLVM library of version {OLDEST_LLVM} or newer was found: `pip install karellen-llvm-core` "
        "(Linux x86-64), install your system's LLVM, or set DRJIT_LIBLLVM_PATH"
    )


def gather_at_once() -> None:
    """Let kernels gather by one instruction on a CPU with AVX2 alone, once the LLVM backend of Dr.Jit runs.
    Where LLVM thinks that slow, on those of AMD, it branches for each lane: kernels then compile 1.4 to 3 times as
    long and walks run 1.4 times as long, with the same bits. Only Dr.Jit for Linux has what is called here."""
    import drjit as dr

    path = Path(dr.__file__).parent / "libdrjit-core.so"
    library = ctypes.CDLL(str(path)) if path.exists() else None
    if not all(hasattr(library, name) for name in (_CPU, _FEATURES, _LANES, _SET_TARGET)):
        return
    cpu, features, lanes, set_target = (getattr(library, name) for name in (_CPU, _FEATURES, _LANES, _SET_TARGET))
    cpu.restype = features.restype = ctypes.c_char_p
    set_target.argtypes, set_target.restype = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32), None
    known = (features() or b"").split(b",")
    if b"+avx2" in known and b"+avx512f" not in known and b"+fast-gather" not in known:
        set_target(cpu(), b",".join([*known, b"+fast-gather"]), lanes())


# functions of Dr.Jit that Python has no name for
_CPU, _FEATURES = "_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv"
_LANES, _SET_TARGET = "_Z21jit_llvm_vector_widthv", "_Z19jit_llvm_set_targetPKcS0_j"


def two_threads() -> None:
    """Give Dr.Jit a second thread on a machine with one core: Mitsuba waits forever for EXR files with a single one."""
    import drjit as dr

    if dr.thread_count() < 2:
        dr.set_thread_count(2)


def cores() -> int:
    """Cores that this process may use, by its affinity and the quota of its control group, at least one."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        return max(min(here, int(quota) // int(period)), 1)
    except (OSError, ValueError):  # none, or "max"
        return here


def limit_threads(threads: int) -> None:
    """Give this process that many threads: those of Dr.Jit, BLAS and torch."""
    from threadpoolctl import threadpool_limits

    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # of libraries not loaded yet
        os.environ[name] = str(threads)
    threadpool_limits(threads)
    prepare_llvm()
    import drjit as dr

    dr.set_thread_count(threads)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """One thread of the BLAS: its sums then have one order, and small matrices are slower with more.
    On a machine that has other work they are so many times over."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


@once
def _controller() -> ThreadpoolController:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def busy_threads() -> int:
    """Threads of Dr.Jit that can run at once."""
    import drjit as dr

    return min(dr.thread_count(), cores())


def clock() -> float:
    """Seconds: on a CPU those of all threads over their number, on which what else runs has little influence."""
    import mitsuba as mi

    return time.process_time() / busy_threads() if mi.variant().startswith("llvm") else time.perf_counter()


@once
def array_types(backend: str = "llvm") -> ModuleType:
    """The module of Dr.Jit array types of a backend (`drjit.llvm` or `drjit.cuda`), ready to compute.
    ValueError if the name is not a backend. BackendError if the backend cannot run on this machine."""
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend == "llvm":
        prepare_llvm()
    import drjit as dr

    if not dr.has_backend(getattr(dr.JitBackend, backend.upper())):
        raise BackendError(f"Dr.Jit's {backend} backend cannot run here")
    if backend == "llvm":
        gather_at_once()
    return getattr(dr, backend)
