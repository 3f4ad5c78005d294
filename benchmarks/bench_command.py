"""The study `bench`: what walks, Mitsuba's volume path tracer, models, maps and renders cost here, by CPU or GPU."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from halfspace_sss.cli import shared


class BenchPart(str, Enum):
    """What is measured."""

    walk = "walk"
    volpath = "volpath"
    models = "models"
    maps = "maps"
    trace = "trace"
    renders = "renders"
    learnt = "learnt"
    edits = "edits"
    first = "first"
    guided = "guided"


PARTS = tuple(part.value for part in BenchPart)
OF_GPU = ("trace", "renders", "learnt", "edits", "first")  # parts that a GPU has
OF_BACKEND = {"llvm": PARTS[:4], "cuda": ("trace", "renders", "edits", "first")}  # where no part is asked for
# about, for a row; only the time left depends on it
SECONDS = {
    "walk": 1, "volpath": 15, "models": 3, "maps": 100,
    "trace": 2, "renders": 12, "learnt": 60, "edits": 10, "first": 30, "guided": 1,
}  # fmt: skip
SIZES = {"llvm": 256, "cuda": 1024}  # pixels of square images; those of `renders` are half as wide
EVENTS = {"llvm": 2**27, "cuda": 2**34}  # of a trace
TITLES = {
    "walk": "walk at normal incidence, flux alone or with peel-off towards one direction",
    "volpath": "Mitsuba's volpath for the same reflectance: time for equal error over the time of the walk",
    "models": "evaluations of S per second, float32; NumPy runs on one thread, torch and Dr.Jit on all",
    "maps": "training maps to a mean cell error",
    "trace": "`trace` at normal incidence, all that it does counted",
    "renders": "variance x time of volpathmis over that of a way, summed over the pixels of the object",
    "learnt": "the same of a learnt object, light sampled",
    "edits": "seconds of the first image of a scene, and after an edit, 1 sample a pixel",
    "guided": "variance x time of plain walks in the half-space over that of walks guided towards the surface",
    "first": "seconds of a new process to its first image, with no kernel known and with all",
}
COLUMNS = {  # key of a row -> heading and format
    "albedo": ("albedo", "{:g}"), "g": ("g", "{:g}"), "eta": ("eta", "{:g}"),
    "peel_off": ("peel-off", "{}"), "events_per_s": ("events/s", "{:.2e}"), "paths_per_s": ("paths/s", "{:.2e}"),
    "events_per_path": ("events/path", "{:.3g}"), "rr_depth": ("roulette\ndepth", "{}"),
    "mean": ("reflectance", "{:.4f}"), "standard_error": ("standard\nerror", "{:.1e}"),
    "equal_error_ratio": ("times slower\nthan the walk", "{:.3g}"),
    "model": ("model", "{}"), "orders": ("orders", "{}"),
    "weight_variance": ("variance of\nsample weight", "{:.2f}"),
    "numpy": ("NumPy", "{:.1e}"), "torch": ("torch", "{:.1e}"), "drjit": ("Dr.Jit", "{:.1e}"), "maps": ("maps", "{}"),
    "object": ("object", "{}"), "light": ("light", "{}"), "way": ("way", "{}"), "pixels": ("pixels", "{}"),
    "guided": ("guided\nflights", "{:g}"), "over_plain": ("plain walks\nover it", "{:.2f}"),
    "ns": ("ns a sample", "{:.1f}"), "cells_s": ("cells, s", "{:.2f}"),
    "over_volpathmis": ("volpathmis\nover it", "{:.2f}"), "ready_s": ("ready", "{:.2f}"),
    "light_s": ("light turned", "{:.3f}"), "camera_s": ("camera moved", "{:.3f}"),
    "empty_s": ("no kernels", "{:.1f}"), "known_s": ("kernels known", "{:.1f}"),
    "mean_cell_error": ("mean cell\nerror", "{:.3f}"), "seconds": ("seconds", "{:.3g}"), "paths": ("paths", "{:.2e}"),
}  # fmt: skip


def chosen_parts(asked: Sequence[str] | None, backend: str = "llvm") -> list[str]:
    """The parts to measure, in the order of `PARTS`; volpath is compared with the walk and brings it along.

    Raises:
        ValueError: a part is of the CPU alone, and the backend is not.
    """
    asked = asked or OF_BACKEND[backend]
    of_cpu = [part for part in asked if part not in OF_GPU]
    if backend == "cuda" and of_cpu:
        raise ValueError(f"only must be one of {', '.join(OF_GPU)} with --backend cuda, got {of_cpu[0]!r}")
    return [part for part in PARTS if part in asked or (part == "walk" and "volpath" in asked)]


def bench(
    only: Annotated[list[BenchPart] | None, typer.Option(help="A part; repeat for more.", show_default="all")] = None,
    backend: Annotated[Literal["llvm", "cuda"], typer.Option(help="CPU or GPU.")] = "llvm",
    quick: Annotated[bool, typer.Option("--quick", help="Small runs that only show that everything works.")] = False,
    out: shared.OutFolder = Path("bench"),
) -> None:
    """Measure speed: events a second, equal-error time over Mitsuba, models, maps, renders, edits, first images.

    The default for a CPU is walk, volpath, models and maps; for a GPU, trace, renders, edits and first. Rows of an
    interrupted run are written and printed.
    """
    from benchmarks.bench import machine, peak_memory
    from halfspace_sss.backend import array_types
    from halfspace_sss.provenance import check_folder, provenance, write_together

    parts, notes = chosen_parts(only, backend), []
    check_folder(out)
    if "volpath" in parts and find_spec("mitsuba") is None:
        parts.remove("volpath")
        notes.append("volpath is left out: Mitsuba is not installed (`pip install halfspace-sss[render]`)")
    if "models" in parts and find_spec("torch") is None:
        notes.append("the models are not measured in torch, which is not installed")
    array_types(backend)
    tables: dict[str, list[dict]] = {part: [] for part in parts}
    interrupt = None
    try:
        _measure(tables, backend, quick)
    except KeyboardInterrupt as error:
        interrupt = error
    measured = {part: rows for part, rows in tables.items() if rows}
    if interrupt and not measured:
        raise interrupt

    import pandas

    memory = peak_memory()
    files = {out / f"bench_{part}.csv": shared.csv_of(pandas.DataFrame(rows)) for part, rows in measured.items()}
    about = {
        "provenance": provenance(quick=quick, parts=parts, backend=backend),
        "machine": machine(backend),
        "notes": notes,
    }
    about |= {"peak_memory_gib": memory, **measured}
    files[out / "bench.json"] = json.dumps(about, indent=1, allow_nan=False) + "\n"
    write_together(files)
    for part, rows in measured.items():
        keys = [key for key in rows[0] if key in COLUMNS]
        cells = [[_cell(key, row[key]) for key in keys] for row in rows]
        shared.say(TITLES[part], shared.table([COLUMNS[key][0] for key in keys], cells))
    shared.say(*notes, *([] if memory is None else [f"peak memory {memory:.2f} GiB"]), "written:")
    shared.say_files(files)
    if interrupt:
        raise interrupt


def _measure(tables: dict[str, list[dict]], backend: str, quick: bool) -> None:
    """Add the rows of each part to its table."""
    lengths = _lengths(quick)
    total, done = sum(SECONDS[part] * lengths[part] for part in tables), 0
    with shared.Bar("measuring") as bar:
        for part in tables:
            bar.show(done, total, part)
            for row in _rows(part, backend, quick, tables):
                tables[part].append(row)
                bar.show(done + SECONDS[part] * len(tables[part]), total, part)
            done += SECONDS[part] * lengths[part]  # a model may have refused the medium
            bar.show(done, total, part)


def _lengths(quick: bool) -> dict[str, int]:
    """Number of rows of each part."""
    from benchmarks.bench import MAP_MEDIA, MEDIA, ROULETTE_DEPTHS
    from halfspace_sss import models

    media, depths, maps = (1 if quick else len(each) for each in (MEDIA, ROULETTE_DEPTHS, MAP_MEDIA))
    renders = {"trace": media, "renders": 9, "learnt": 9, "edits": 2, "first": 4, "guided": 8 if quick else 32}
    return {"walk": 2 * media, "volpath": media * depths, "models": len(models()), "maps": maps, **renders}


def _rows(part: str, backend: str, quick: bool, tables: dict[str, list[dict]]) -> Iterator[dict]:
    from benchmarks import bench
    from halfspace_sss.maps.grid import MapGrid

    if part == "walk":
        return bench.bench_walk(1024, 4, bench.MEDIA[:1]) if quick else bench.bench_walk()
    if part == "volpath":
        return bench.bench_volpath(tables["walk"], *((16, 4, (64,)) if quick else ()))
    if part == "models":
        return bench.bench_models(n=64, least_seconds=0.01) if quick else bench.bench_models()
    if part == "trace":
        return bench.bench_traces(backend, 2**16 if quick else EVENTS[backend], bench.MEDIA[: 1 if quick else None])
    if part == "guided":
        from benchmarks.guided_walks import ALBEDOS, bench_guided

        return bench_guided(1024, 4, ALBEDOS[:1]) if quick else bench_guided()
    if part != "maps":
        from benchmarks import bench_renders

        variant, size = f"{backend}_ad_rgb", 32 if quick else SIZES[backend]
        if part == "edits":
            return bench_renders.bench_edits(variant, size)
        if part == "first":
            return bench_renders.bench_first_images(variant, size, 0.0 if quick else bench_renders.TRAINING)
        few = {"spp": 2} if quick else {}
        training = (2.0 if quick else bench_renders.TRAINING) if part == "learnt" else 0.0
        return bench_renders.bench_renders(variant, size // 2, training, **few)
    return bench.bench_maps(1.0, MapGrid(2, 16, 8, 8), bench.MAP_MEDIA[:1]) if quick else bench.bench_maps()


def _cell(key: str, value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return COLUMNS[key][1].format(value)
