"""Computes the parts of a figure that changed, tells how long that will take, and draws the figure from them.

A finished part has a folder on disk, with its images as EXR and a record in JSON that vouches for them.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import json
import os
import re
import shutil
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from types import ModuleType

import numpy as np

import figures
from figures.parts.part import QUALITIES, Params, Part, Result, Task, canonical, check_quality, keys_of
from halfspace_sss.backend import needed, two_threads
from halfspace_sss.checks import check_choice
from halfspace_sss.executors import completed
from halfspace_sss.progress import Progress, ProgressText
from halfspace_sss.provenance import JsonDict, check_folder, provenance, write_together


def _mitsuba() -> tuple[type, type]:
    """Bitmap and MemoryStream, which need no variant."""
    mi = needed("mitsuba", "images need Mitsuba 3", "render")
    two_threads()
    return mi.Bitmap, mi.MemoryStream


def exr_bytes(image: np.ndarray, name: str, about: str) -> bytes:
    """The image as the content of an EXR file; the same image and text give the same bytes.

    Args:
        image: (H, W) or (H, W, 3), finite.
        name: how errors call it.
        about: provenance, kept in the header under that name.

    Raises:
        ValueError: the shape is another, or a value is not finite in float32.
        BackendError: Mitsuba is not installed.
    """
    Bitmap, MemoryStream = _mitsuba()
    if image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)) or 0 in image.shape:
        raise ValueError(f"{name} must have the shape (height, width) or (height, width, 3), got {image.shape}")
    with np.errstate(over="ignore"):
        pixels = np.ascontiguousarray(image, dtype=np.float32)
    bad = ~np.isfinite(pixels)
    if bad.any():
        where = tuple(int(k) for k in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} must be finite, got {float(image[where])!r} at {where} ({int(bad.sum())} such values)"
        )
    bitmap, stream = Bitmap(pixels), MemoryStream()
    bitmap.metadata()["provenance"] = about
    bitmap.write(stream, Bitmap.FileFormat.OpenEXR)
    return bytes(stream.raw_buffer())


def read_exr(path: str | os.PathLike[str]) -> np.ndarray:
    """The float32 image of an EXR file, (H, W) or (H, W, channels); ValueError with its name if it cannot be read."""
    Bitmap, _ = _mitsuba()
    try:
        return np.array(Bitmap(os.fspath(path)), dtype=np.float32)
    except RuntimeError as error:
        raise ValueError(f"{os.fspath(path)} must be an EXR image: {error}") from error


FORMAT, RECORD = 1, "record.json"


class PartStore:
    """The parts of one figure in one quality.

    Args:
        folder: holds a folder for each part; made when the first part is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def holds(self, part: Part, key: str) -> bool:
        """Whether there is a result of what `key` stands for; a warning names one whose files are damaged."""
        try:
            return self._record(part, key) is not None
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            warnings.warn(f"part {part.name!r} is damaged, {self.folder / part.slug}: {error}", stacklevel=2)
            return False

    def _record(self, part: Part, key: str) -> JsonDict | None:
        """The record of a result, whose files are as they were written; None if there is none of that key."""
        path = self.folder / part.slug / RECORD
        if not path.exists():
            return None
        record = json.loads(path.read_text(encoding="utf-8"))
        if record.pop("checksum") != _checksum(record) or record["format"] != FORMAT:
            raise ValueError(f"{RECORD} must be of format {FORMAT} with the checksum of its content")
        if record["key"] != key:
            return None
        for about in record["images"].values():
            if hashlib.sha256(path.with_name(about["file"]).read_bytes()).hexdigest() != about["sha256"]:
                raise ValueError(f"{about['file']} must have the checksum of its record")
        return record

    def load(self, part: Part, key: str) -> Result:
        """The result of a part that the store holds."""
        record = self._record(part, key)
        images = {name: read_exr(self.folder / part.slug / about["file"]) for name, about in record["images"].items()}
        return Result(images, record["numbers"], record["seconds"], record["work"])

    def save(self, part: Part, key: str, values: Params, seconds: float) -> None:
        """Write what the function of a part returned; every file is whole or absent, the record comes last.

        Args:
            part, key: what was computed, from what.
            values: arrays and values by name.
            seconds: that it took.

        Raises:
            ValueError: an array has a wrong shape or a value that is not finite, or something is not ready for JSON.
        """
        folder, of = self.folder / part.slug, f"of part {part.name!r}"
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        numbers = {name: value for name, value in values.items() if name not in arrays}
        canonical(numbers, f"numbers {of}")
        for name in arrays:
            if not re.fullmatch(r"[\w-]+", name):
                raise ValueError(f"images {of} must be named by letters, digits, _, -, got {name!r}")
        origin = provenance(part=part.name, kind=part.kind, **part.params)
        about = canonical({**origin, "key": key}, f"provenance {of}")
        files = {f"{name}.exr": exr_bytes(array, f"{name} {of}", about) for name, array in arrays.items()}
        record = {"format": FORMAT, "part": part.name, "key": key, "kind": part.kind, "work": part.work}
        record |= {"seconds": seconds, "numbers": numbers, "provenance": origin}
        record["inputs"] = [Path(path).name for path in part.inputs]
        record["images"] = {
            file.removesuffix(".exr"): {"file": file, "sha256": hashlib.sha256(data).hexdigest()}
            for file, data in files.items()
        }
        record = json.loads(json.dumps(record))
        text = json.dumps({**record, "checksum": _checksum(record)}, indent=1) + "\n"
        write_together({folder / file: data for file, data in {**files, RECORD: text}.items()})
        for path in folder.iterdir():  # of an earlier result, or of the way to this one
            if path.name.startswith("unfinished-"):
                shutil.rmtree(path, ignore_errors=True)
            elif path.suffix == ".exr" and path.name not in files:
                path.unlink()

    def unfinished(self, part: Part, key: str) -> Path:
        """Folder in which a part keeps what it has done so far; another key has another one."""
        return self.folder / part.slug / f"unfinished-{key[:16]}"

    def seconds(self) -> Iterator[tuple[str, float, float]]:
        """Kind, work and seconds of every part that has a readable record."""
        for path in sorted(self.folder.glob(f"*/{RECORD}")):
            with contextlib.suppress(ValueError, KeyError, TypeError, OSError):  # it is not worth an error
                record = json.loads(path.read_text(encoding="utf-8"))
                yield record["kind"], float(record["work"]), float(record["seconds"])


def _checksum(record: JsonDict) -> str:
    return hashlib.sha256(canonical(record, "record").encode()).hexdigest()


def projected(parts: Sequence[Part], stores: Iterable[PartStore]) -> dict[str, float | None]:
    """Seconds that parts will take, by name: their work, at the median rate of parts of their kind in the stores.

    None where no part of the kind was computed.
    """
    rates: dict[str, list[float]] = {}
    for kind, work, seconds in (record for store in stores for record in store.seconds()):
        rates.setdefault(kind, []).append(seconds / work)
    return {part.name: median(rates[part.kind]) * part.work if part.kind in rates else None for part in parts}


def duration(seconds: float) -> str:
    """Seconds as people say them: "40 s", "12 min", "3.5 h"."""
    if seconds < 99.5:
        return f"{seconds:.2g} s" if seconds < 9.95 else f"{seconds:.0f} s"
    if seconds < 99.5 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


STEPS = 10_000  # of the bar


@dataclass(frozen=True)
class Plan:
    """What a figure is made of and what of it there is.

    Attributes:
        name, quality, folder: of the figure; its pictures go there, its parts below.
        parts, keys: in the order of computing; the hash of what each depends on, by name.
        missing: names of the parts to be computed.
        seconds: projected for each missing part that no other figure has, by name.
    """

    name: str
    quality: str
    folder: Path
    parts: tuple[Part, ...]
    keys: Mapping[str, str]
    missing: tuple[str, ...]
    seconds: Mapping[str, float | None]

    @property
    def store(self) -> PartStore:
        """Where its parts are."""
        return PartStore(self.folder / "parts")

    @property
    def projected_seconds(self) -> float:
        """Of the missing parts whose time can be told."""
        return sum(seconds or 0.0 for seconds in self.seconds.values())

    @property
    def unmeasured(self) -> tuple[str, ...]:
        """Missing parts like which nothing was measured."""
        return tuple(name for name, seconds in self.seconds.items() if seconds is None)


def figure(name: str) -> ModuleType:
    """The module of a figure; ValueError with the nearest name if there is none."""
    modules = figures.figure_modules()
    check_choice("figure", name, modules)
    return importlib.import_module(modules[name])


def plan(name: str, quality: str, out: str | Path) -> Plan:
    """What is to be done for a figure, which lies in OUT/NAME/QUALITY; reads every finished part, computes nothing.

    Raises:
        ValueError: no such figure or quality, out is a file, or a part is not well formed.
    """
    module = figure(name)
    check_quality(quality)
    folder = check_folder(out) / name
    parts = tuple(module.parts(quality))
    keys = keys_of(parts)
    store = PartStore(folder / quality / "parts")
    missing = [part for part in parts if not store.holds(part, keys[part.name])]
    ahead = [part for part in missing if not _elsewhere(folder / quality, part, keys[part.name])]
    seconds = projected(ahead, (PartStore(folder / each / "parts") for each in QUALITIES))
    names = tuple(part.name for part in missing)
    return Plan(
        name=name, quality=quality, folder=folder / quality, parts=parts, keys=keys, missing=names, seconds=seconds
    )


def compute(
    name: str, quality: str, out: str | Path, progress: ProgressText | None = None, executor: Executor | None = None
) -> dict[str, Result]:
    """Compute what is missing, damaged or changed of a figure; finished parts survive an interruption.

    Args:
        name, quality, out: as in `plan`.
        progress: called with (steps done, steps in all, name of the part).
        executor: where parts are computed and written (see `halfspace_sss.executors`); by default in this process.

    Returns:
        The results of all parts by name.

    Raises:
        ValueError: as in `plan`, or from a part, whose name it gives.
    """
    todo = plan(name, quality, out)
    for _ in completed_plans([todo], progress, executor):
        pass
    return {part.name: todo.store.load(part, todo.keys[part.name]) for part in todo.parts}


def completed_plans(
    plans: Sequence[Plan],
    progress: ProgressText | None = None,
    executor: Executor | None = None,
    most: int | None = None,
) -> Iterator[Plan]:
    """Compute what several figures lack, what they share once; gives each plan as soon as all of its parts are there.

    Args:
        plans: as `plan` makes them.
        progress, executor: as in `compute`.
        most: parts that the executor is given at a time; all that can run by default.

    Raises:
        ValueError: from a part, whose name it gives.
    """
    if executor:
        plans = [replace(todo, folder=todo.folder.absolute()) for todo in plans]
    owners: dict[str, str] = {}  # names of the first parts of these keys
    weights, parts, needs, left = {}, {}, {}, {}
    done, measured = 0.0, not any(todo.unmeasured for todo in plans)

    def show(name: str, told: str, k: int, n: int) -> None:
        if progress:
            progress(int(STEPS * (done + weights[name] * k / max(n, 1)) / sum(weights.values())), STEPS, told)

    for todo in plans:
        known = {part: f"{todo.name}, part {part!r}" for part in todo.missing}
        left[todo.name] = set(known.values())
        for part in (part for part in todo.parts if part.name in known):
            name, key = known[part.name], todo.keys[part.name]
            told = part.name if len(plans) == 1 else f"{todo.name}: {part.name}"
            parts[name] = (todo, part.name, None if executor else functools.partial(show, name, told))
            owner = owners.setdefault(key, name)
            needs[name] = [*(known[each] for each in part.needs if each in known), *([owner] if owner != name else [])]
            weights[name] = _weight(todo, part, measured) if owner == name else LEAST
    yield from (todo for todo in plans if not todo.missing)
    for name, (todo, part) in completed(executor, _computed, parts, needs, most):
        done += weights[name]
        show(name, part if len(plans) == 1 else f"{todo}: {part}", 0, 1)
        left[todo].remove(name)
        if not left[todo]:
            yield next(p for p in plans if p.name == todo)


def draw(name: str, quality: str, out: str | Path) -> list[Path]:
    """Draw a figure from its finished parts: writes OUT/NAME/QUALITY/FILE for every file, and NAME.json.

    Raises:
        ValueError: as in `plan`; a part is missing, changed or damaged.
    """
    done = plan(name, quality, out)
    if done.missing:
        few = ", ".join(repr(part) for part in done.missing[:3]) + (", ..." if len(done.missing) > 3 else "")
        raise ValueError(
            f"parts of {name} must be computed before it is drawn, {len(done.missing)} of {len(done.parts)} are not: "
            f"{few}; `halfspace-sss figures compute {name} --quality {quality}` does it"
        )
    results = {part.name: done.store.load(part, done.keys[part.name]) for part in done.parts}
    content = dict(figure(name).draw(results))
    about = provenance(figure=name, quality=quality)
    about["parts"] = {
        part.name: {"key": done.keys[part.name], "params": part.params, "seconds": results[part.name].seconds}
        for part in done.parts
    }
    content[f"{name}.json"] = json.dumps({**about, "files": sorted(content)}, indent=1) + "\n"
    write_together({done.folder / file: data for file, data in content.items()})
    return [done.folder / file for file in content]


LEAST = 1e-3  # that a part counts in the bar


def _weight(todo: Plan, part: Part, measured: bool) -> float:
    """What a missing part counts in the bar: its seconds, or its share of the work while some are unknown."""
    if not measured:
        missing = [each for each in todo.parts if each.name in todo.missing]
        return len(missing) * part.work / sum(each.work for each in missing)
    return max(todo.seconds.get(part.name) or 0.0, LEAST)


def _elsewhere(folder: Path, part: Part, key: str) -> PartStore | None:
    """Where another figure has the same part in the same quality: keys agree only where all that it depends on does."""
    places = (PartStore(place) for place in sorted(folder.parent.parent.glob(f"*/{folder.name}/parts")))
    return next((store for store in places if store.holds(part, key)), None)


def _computed(todo: Plan, name: str, show: Progress | None) -> tuple[str, str]:
    """Compute a part, with what it needs from its store, and write it there; names of its figure and itself."""
    parts = {part.name: part for part in todo.parts}
    part, key = parts[name], todo.keys[name]
    other = _elsewhere(todo.folder, part, key)
    if other:
        result = other.load(part, key)
        todo.store.save(part, key, {**result.images, **result.numbers}, result.seconds)
        return todo.name, name
    folder = todo.store.unfinished(part, key)
    folder.mkdir(parents=True, exist_ok=True)
    needed = {needs: todo.store.load(parts[needs], todo.keys[needs]) for needs in part.needs}
    inputs = tuple(Path(path) for path in part.inputs)
    task = Task(part.params, folder, needed, inputs, **({"progress": show} if show else {}))
    if show:
        show(0, 1)
    started = time.perf_counter()
    try:
        result = part.function(task)
        todo.store.save(part, key, result, time.perf_counter() - started)
    finally:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    return todo.name, name
