"""Finished parts on disk: a folder for each, with its images as EXR and a record in JSON that vouches for them."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from figures.parts.part import Part, Result, canonical
from halfspace_sss.backend import BackendError, two_threads
from halfspace_sss.provenance import provenance, write_together


def _mitsuba() -> tuple[type, type]:
    """Bitmap and MemoryStream, which need no variant."""
    try:
        from mitsuba import Bitmap, MemoryStream
    except ModuleNotFoundError as error:
        raise BackendError('images need Mitsuba 3: pip install "halfspace-sss[render]"') from error
    two_threads()
    return Bitmap, MemoryStream


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


def read_exr(path: str | os.PathLike) -> np.ndarray:
    """The float32 image of an EXR file, (H, W) or (H, W, channels); ValueError with its name if it cannot be read."""
    Bitmap, _ = _mitsuba()
    try:
        return np.array(Bitmap(os.fspath(path)), dtype=np.float32)
    except RuntimeError as error:
        raise ValueError(f"{os.fspath(path)} must be an EXR image: {error}") from error


FORMAT = 1


class DamagedPartError(ValueError):
    """A file of a finished part is missing or is not what its record says; the message names it."""


class PartStore:
    """The parts of one figure in one quality.

    Args:
        folder: holds a folder for each part; made when the first part is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def record(self, part: Part) -> dict[str, Any] | None:
        """The checked record of a part, None if there is none; the images are not looked at.

        Raises:
            DamagedPartError: it cannot be read, or is not what was written.
        """
        path = self._record_path(part)
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            checksum = record.pop("checksum")
            sound = record["format"] == FORMAT and checksum == _checksum(record)
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            raise DamagedPartError(f"{path} must be the record of a part: {type(error).__name__}: {error}") from error
        if not sound:
            raise DamagedPartError(f"{path} must be a record of format {FORMAT} with the checksum of its content")
        return record

    def holds(self, part: Part, key: str) -> bool:
        """Whether there is a result of what `key` stands for, with all its files as they were written.

        Raises:
            DamagedPartError: a file is missing or damaged.
        """
        record = self.record(part)
        if record is None or record["key"] != key:
            return False
        for about in record["images"].values():
            self._checked_image(part, about)
        return True

    def load(self, part: Part, key: str) -> Result | None:
        """The result of a part, None if there is none of what `key` stands for.

        Raises:
            DamagedPartError: a file is missing or damaged.
        """
        record = self.record(part)
        if record is None or record["key"] != key:
            return None
        images = {name: read_exr(self._checked_image(part, about)) for name, about in record["images"].items()}
        return Result(images, record["numbers"], record["seconds"], record["work"])

    def save(self, part: Part, key: str, values: Mapping[str, Any], seconds: float) -> Result:
        """Write what the function of a part returned; every file is whole or absent, the record comes last.

        Args:
            part, key: what was computed, from what.
            values: arrays and values by name.
            seconds: that it took.

        Raises:
            ValueError: an array has a wrong shape or a value that is not finite, or something is not ready for JSON.
        """
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        numbers = {name: value for name, value in values.items() if name not in arrays}
        canonical(numbers, f"numbers of part {part.name!r}")
        for name in arrays:
            if not re.fullmatch(r"[\w-]+", name):
                raise ValueError(f"images of part {part.name!r} must be named by letters, digits, _, -, got {name!r}")
        origin = provenance(part=part.name, kind=part.kind, **part.params)
        about = canonical({**origin, "key": key}, f"provenance of part {part.name!r}")
        images = {name: exr_bytes(array, f"{name} of part {part.name!r}", about) for name, array in arrays.items()}
        files = {f"{name}.exr": data for name, data in images.items()}
        record = {"format": FORMAT, "part": part.name, "key": key, "kind": part.kind, "work": part.work}
        record |= {"seconds": seconds, "numbers": numbers, "provenance": origin}
        record["inputs"] = [Path(path).name for path in part.inputs]
        record["images"] = {
            name: {"file": f"{name}.exr", "sha256": hashlib.sha256(data).hexdigest()} for name, data in images.items()
        }
        record = json.loads(json.dumps(record))
        text = json.dumps({**record, "checksum": _checksum(record)}, indent=1)
        places = {self._part_folder(part) / file: data for file, data in files.items()}
        write_together({**places, self._record_path(part): text + "\n"})
        self._sweep(part, set(files))
        shown = {name: array.astype(np.float32) for name, array in arrays.items()}
        return Result(shown, record["numbers"], seconds, part.work)

    def unfinished(self, part: Part, key: str) -> Path:
        """Folder in which a part keeps what it has done so far; another key has another one."""
        return self._part_folder(part) / f"unfinished-{key[:16]}"

    def seconds(self) -> Iterator[tuple[str, float, float]]:
        """Kind, work and seconds of every part that has a sound record."""
        for path in sorted(self.folder.glob("*/record.json")):
            try:
                record = json.loads(path.read_text(encoding="utf-8"))
                yield record["kind"], float(record["work"]), float(record["seconds"])
            except (ValueError, KeyError, TypeError, OSError):
                continue  # what a damaged record says of time is not worth an error

    def _part_folder(self, part: Part) -> Path:
        return self.folder / part.slug

    def _record_path(self, part: Part) -> Path:
        return self._part_folder(part) / "record.json"

    def _checked_image(self, part: Part, about: Mapping[str, str]) -> Path:
        path = self._part_folder(part) / about["file"]
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DamagedPartError(f"{path} must be an image of part {part.name!r}: {error.strerror}") from error
        if hashlib.sha256(data).hexdigest() != about["sha256"]:
            raise DamagedPartError(f"{path} must have the checksum of its record, got a changed or cut file")
        return path

    def _sweep(self, part: Part, keep: set[str]) -> None:
        """Remove what belonged to an earlier result or to the way to this one."""
        for path in self._part_folder(part).iterdir():
            if path.name.startswith("unfinished-"):
                shutil.rmtree(path, ignore_errors=True)
            elif path.suffix == ".exr" and path.name not in keep:
                path.unlink()


def _checksum(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(canonical(record, "record").encode()).hexdigest()
