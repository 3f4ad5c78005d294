"""What things cost: the walk, the walk against Mitsuba's volpath at equal error, and every model per backend.

Every function yields its rows one by one, as they are measured.
"""

from __future__ import annotations

import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_tracing import MapUnit, trace_unit
from halfspace_sss.measure import reflectance, weight_variance
from halfspace_sss.physics.fresnel import F_r, F_t
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import _inverse
from halfspace_sss.registry import bssrdf, models
from halfspace_sss.tracing.passes import AngularTally, FluxTally
from halfspace_sss.tracing.tracer import trace
from halfspace_sss.tracing.walk import Tally, pass_seed, walk

MEDIA = ((0.75, 0.0, 1.3), (0.99, 0.0, 1.5), (0.999, 0.9, 1.3))
MAP_MEDIA = ((0.75, 0.0, 1.3), (0.99, 0.8, 1.5))
ROULETTE_DEPTHS = (5, 64, 256, 1024)
REPEATS = 3
Row = dict[str, bool | float | str]
Media = Sequence[tuple[float, float, float]]  # albedo, g, eta


def _medium(albedo: float, g: float, eta: float) -> Medium:
    return Medium.from_albedo(albedo, 1.0, g, eta)


def _walk_once(medium: Medium, lanes: int, per_lane: int, seed: int, peel_off: bool) -> tuple[np.ndarray, int, float]:
    """Reflectance of each lane, events and seconds of one launch at normal incidence."""
    types = array_types()
    tally: Tally = FluxTally(types)
    if peel_off:
        tally = AngularTally(types, medium.g, medium.eta, np.array([1.0]), np.array([0.0]))
    started = time.perf_counter()
    start = types.Float(np.full(lanes, 1.0))
    ((single, multiple),), events = walk(types, medium, start, per_lane, pass_seed(seed), [tally])
    flux = (single.numpy().astype(float) + multiple.numpy()) / per_lane * F_t(1.0, medium.eta)
    count = int(events.numpy().astype(np.int64).sum())
    return flux, count, time.perf_counter() - started


def bench_walk(lanes: int = 32768, per_lane: int = 64, media: Media = MEDIA) -> Iterator[Row]:
    """Events and paths per second of the walk, recording flux alone and with peel-off towards one direction.

    Medians over three launches after one that compiles; efficiency is 1 / (variance of a path x seconds a path).
    """
    for albedo, g, eta in media:
        medium = _medium(albedo, g, eta)
        for peel_off in (False, True):
            _walk_once(medium, 1024, 1, 0, peel_off)
            runs = [_walk_once(medium, lanes, per_lane, seed, peel_off) for seed in range(1, REPEATS + 1)]
            seconds = statistics.median(run[2] for run in runs)
            paths, events = lanes * per_lane, runs[0][1]
            variance = float(np.mean([run[0].var(ddof=1) for run in runs])) * per_lane
            row: Row = {"albedo": albedo, "g": g, "eta": eta, "peel_off": peel_off}
            row |= {"events_per_s": events / seconds, "paths_per_s": paths / seconds, "events_per_path": events / paths}
            if not peel_off:
                row |= {"sd_per_path": math.sqrt(variance), "efficiency": paths / (variance * seconds)}
            yield row


def bench_traces(backend: str, n_events: int, media: Media = MEDIA) -> Iterator[Row]:
    """Events per second of `trace`, with all that it does besides its kernels, which are known.

    Args:
        backend: "llvm" or "cuda".
        n_events: of each medium, about, at normal incidence.
        media: albedo, g and eta of each.
    """
    for albedo, g, eta in media:
        medium = _medium(albedo, g, eta)
        pilot = trace(medium, n_paths=2**14, backend=backend)
        n_paths = n_events // (pilot.n_events // pilot.n_paths + 1)
        runs = [trace(medium, n_paths=n_paths, seed=seed, backend=backend) for seed in range(1, REPEATS + 1)]
        seconds = statistics.median(run.seconds for run in runs)
        row: Row = {"albedo": albedo, "g": g, "eta": eta, "paths": float(runs[0].n_paths), "seconds": seconds}
        yield row | {"events_per_s": runs[0].n_events / seconds}


def _half_space(mi: ModuleType, albedo: float, g: float, eta: float, rr_depth: int, size: int) -> object:
    """Orthographic camera onto a lit plane: by reciprocity a pixel is the reflectance at normal incidence."""
    T = mi.ScalarTransform4f
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "luminance", "component_format": "float32"}
    camera = {"type": "orthographic", "to_world": T().look_at([0, 0, 10], [0, 0, 0], [0, 1, 0]), "film": film}
    interior = {"type": "homogeneous", "albedo": albedo, "sigma_t": 1.0, "phase": phase}
    plane = {"type": "rectangle", "to_world": T().scale([1e4, 1e4, 1]), "interior": interior}
    plane["bsdf"] = {"type": "dielectric", "int_ior": eta, "ext_ior": 1.0}
    integrator = {"type": "volpath", "max_depth": -1, "rr_depth": rr_depth}
    light = {"type": "constant", "radiance": 1.0}
    return mi.load_dict({"type": "scene", "i": integrator, "camera": camera, "light": light, "plane": plane})


def bench_volpath(
    walk_rows: Sequence[Row], size: int = 256, spp: int = 4, depths: Sequence[int] = ROULETTE_DEPTHS
) -> Iterator[Row]:
    """Equal-error ratio of the walk and Mitsuba's `volpath` on total reflectance at normal incidence.

    For each medium of `walk_rows`, which `bench_walk` gave, and each Russian-roulette depth: 1 / (variance x time) of
    volpath, and how many times more that of the walk is. volpath includes the specular reflection, which the walk
    knows exactly; the variance is over pixels.
    """
    array_types()
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    for ours in (row for row in walk_rows if not row["peel_off"]):
        albedo, g, eta = ours["albedo"], ours["g"], ours["eta"]
        for rr_depth in depths:
            scene = _half_space(mi, albedo, g, eta, rr_depth, size)
            np.array(mi.render(scene, spp=1, seed=0))
            started = time.perf_counter()
            image = np.array(mi.render(scene, spp=spp, seed=1)).astype(np.float64).ravel()
            seconds = time.perf_counter() - started
            variance = image.var(ddof=1) * spp
            efficiency = image.size * spp / (variance * seconds)
            row: Row = {"albedo": albedo, "g": g, "eta": eta, "rr_depth": rr_depth}
            row |= {"mean": image.mean() - F_r(1.0, eta), "standard_error": math.sqrt(variance / (image.size * spp))}
            row |= {"paths_per_s": image.size * spp / seconds, "efficiency": efficiency}
            yield row | {"equal_error_ratio": ours["efficiency"] / efficiency}


def _rate(call: Callable[[], object], n: int, least_seconds: float) -> float:
    """Queries per second, median of repeats that each last at least `least_seconds`."""
    call()
    rates = []
    for _ in range(REPEATS):
        done, started = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - started) < least_seconds:
            call()
            done += n
        rates.append(done / elapsed)
    return statistics.median(rates)


def _cpu_seconds(call: Callable[[], object]) -> float:
    started = time.process_time()
    call()
    return time.process_time() - started


def _queries(n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    r = np.exp(rng.uniform(math.log(0.01), math.log(10), n))
    mu_i, mu_o = rng.random((2, n))
    phi_i, phi_o = rng.uniform(-math.pi, math.pi, (2, n))
    return [a.astype(np.float32) for a in (r, mu_i, phi_i, mu_o, phi_o)]


def bench_models(names: tuple[str, ...] | None = None, n: int = 1 << 15, least_seconds: float = 0.2) -> Iterator[Row]:
    """Evaluations of S per second in float32, batches of `n`: NumPy, torch (if installed) and Dr.Jit on the CPU.

    With them the relative variance of the weight of the model's own samples, `measure.weight_variance`, and the CPU
    seconds of one `measure.reflectance`, warm, and of one `Medium.from_reflectance`, cold (no model is in it).

    Dr.Jit is given batches 16 times as large, since a kernel launch has a fixed cost; the sum of S is evaluated.
    """
    types = array_types()
    import drjit as dr

    try:
        import torch
    except ImportError:
        torch = None
    medium = _medium(0.75, 0.0, 1.3)
    _inverse.cache_clear()
    colour_seconds = _cpu_seconds(lambda: Medium.from_reflectance(0.5, 1.0, 0.3, 1.37))
    for name in names or models():
        try:
            model = bssrdf(name, medium)
        except ValueError:
            if names:
                raise
            continue  # not trained for this medium
        arrays, many = _queries(n), [types.Float(a) for a in _queries(16 * n)]
        dr.eval(many)
        row: Row = {"model": name, "orders": model.orders, "weight_variance": weight_variance(model)}
        reflectance(model, 0.9)
        row["reflectance_s"] = statistics.median(
            _cpu_seconds(lambda m=model: reflectance(m, 0.9)) for _ in range(REPEATS)
        )
        row["from_reflectance_s"] = colour_seconds
        row["numpy"] = _rate(lambda m=model, q=arrays: m.eval(*q), n, least_seconds)
        if torch is not None:
            tensors = [torch.from_numpy(a) for a in arrays]
            with torch.no_grad():
                row["torch"] = _rate(lambda m=model, q=tensors: m.eval(*q), n, least_seconds)
        row["drjit"] = _rate(lambda m=model, q=many: dr.sum(m.eval(*q)).numpy(), 16 * n, least_seconds)
        yield row


def bench_maps(target_error: float = 0.05, grid: MapGrid | None = None, media: Media = MAP_MEDIA) -> Iterator[Row]:
    """Seconds for a set of maps (16 x 64 of 48 x 24 cells) to the target mean cell error, order >= 2."""
    grid = grid or MapGrid()
    for albedo, g, eta in media:
        medium = _medium(albedo, g, eta)
        started = time.perf_counter()
        units = [MapUnit(medium, grid, a, 0, 0, target_error, 2**33) for a in range(grid.n_theta)]
        results = [trace_unit(unit) for unit in units]
        seconds = time.perf_counter() - started
        error = float(np.mean([r.mean_cell_error for r in results]))
        events = sum(r.n_events for r in results)
        row: Row = {"albedo": albedo, "g": g, "eta": eta, "maps": grid.n_theta * grid.n_phi}
        row |= {"mean_cell_error": error, "seconds": seconds}
        yield row | {"paths": sum(r.n_paths for r in results), "events_per_s": events / seconds}


def peak_memory() -> float | None:
    """Largest resident memory of this process so far, GiB; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def machine(backend: str = "llvm") -> dict[str, int | str | None]:
    """What the figures depend on: processor, number of its threads, system, and the GPU where one is measured."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        processor = platform.processor() or platform.machine()
    about = {"processor": processor, "threads": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"}
    if backend == "cuda":
        call = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
        about["gpu"] = subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()
    return about


def kernel_seconds(make: Callable[[], object]) -> float:
    """Seconds in which the kernels run that compute what `make` returns, without tracing and compiling them."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(make())
        dr.sync_thread()
        return 1e-3 * sum(kernel["execution_time"] for kernel in dr.kernel_history([dr.KernelType.JIT]))
