"""What every written file says of its origin, and files that are whole or absent."""

from __future__ import annotations

import functools
import os
import platform
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

__all__ = ["check_folder", "provenance", "write_atomically"]

LIBRARIES = ("halfspace-sss", "numpy", "drjit", "mitsuba", "torch", "xarray", "zarr")


@functools.cache
def _commit() -> str | None:
    """Commit of the source tree this package runs from, None for an installed one."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def provenance(**parameters: Any) -> dict[str, Any]:
    """Command, parameters, versions, commit and platform, ready for JSON."""
    versions = {name: found for name in LIBRARIES if (found := _version(name))}
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return {
        "command": command,
        "parameters": parameters,
        "versions": {"python": platform.python_version(), **versions},
        "commit": _commit(),
    }


def check_folder(folder: str | Path) -> Path:
    """The folder as a path; ValueError if it, or what it would lie in, is a file or cannot be written to."""
    path = Path(folder)
    part = next(part for part in (path, *path.absolute().parents) if part.exists())
    if not part.is_dir():
        raise ValueError(f"folder must be a folder or new, got {str(folder)!r}, where {str(part)!r} is a file")
    try:
        with tempfile.TemporaryFile(dir=part):
            pass
    except OSError as error:
        raise ValueError(f"folder must be one that can be written to, got {str(folder)!r}: {error.strerror}") from error
    return path


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside it and rename it: it is whole or it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
