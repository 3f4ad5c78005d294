"""Finished parts on disk: a folder for each, with its images as EXR and a record in JSON that vouches for them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from figures.parts.part import Params, Part, Result, canonical
from halfspace_sss.backend import BackendError, two_threads
from halfspace_sss.provenance import JsonDict, provenance, write_together


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
