"""What every written file says of its origin, files that are whole or absent, and locks."""

from __future__ import annotations

import contextlib
import errno
import functools
import math
import os
import platform
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, TypeAlias

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Json: TypeAlias = "None | bool | float | str | list[Json] | dict[str, Json]"  # what JSON holds
JsonDict: TypeAlias = "dict[str, Json]"
LARGEST, LARGEST_TEXT = 10**9, 10**7  # bytes
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


def provenance(**parameters: object) -> JsonDict:
    """Command, parameters, versions, commit and platform, ready for JSON."""
    versions = {name: result for name in LIBRARIES if (result := _version(name))}
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return {
        "command": command,
        "parameters": parameters,
        "versions": {"python": platform.python_version(), **versions},
        "commit": _commit(),
    }


def without_nan(value: object) -> Json:
    """With None in place of nan and infinities, which JSON has not."""
    if isinstance(value, dict):
        return {key: without_nan(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def path_of(path: str | os.PathLike[str]) -> Path:
    """A path of this machine, or that of an object store for a URL that fsspec knows, such as s3://BUCKET/maps.
    ValueError if universal_pathlib is not installed, or no file system has the protocol. The package of the file
    system, such as s3fs, is missed when the path is used."""
    if is_remote(path):
        return path
    if "://" not in str(path):
        return Path(path)
    try:
        from upath import UPath
    except ImportError as error:
        raise ValueError(f'{path} needs more packages: pip install "halfspace-sss[cluster]"; {error}') from error
    return UPath(str(path))


def is_remote(path: str | os.PathLike[str]) -> bool:
    """Whether `path_of` found it to be in an object store, where files are whole or absent and nothing is renamed."""
    return hasattr(path, "storage_options")


def check_folder(folder: str | Path) -> Path:
    """The folder as a path; ValueError if it, or what it would lie in, is a file or cannot be written to."""
    path = path_of(folder)
    if is_remote(path):
        probe = path / f".{platform.node()}.{os.getpid()}"
        try:
            probe.write_bytes(b"1")
            probe.unlink()
        except Exception as error:  # packages of object stores raise errors of their own kinds
            raise ValueError(f"folder must be one that can be written to, got {str(path)!r}: {error}") from error
        return path
    part = next(part for part in (path, *path.absolute().parents) if part.exists())
    if not part.is_dir():
        raise ValueError(f"folder must be a folder or new, got {str(folder)!r}, where {str(part)!r} is a file")
    try:
        with tempfile.TemporaryFile(dir=part):
            pass
    except OSError as error:
        raise ValueError(f"folder must be one that can be written to, got {str(folder)!r}: {error.strerror}") from error
    return path


def read_bytes(path: str | Path, most: int = LARGEST) -> bytes:
    """The content of a file; OSError if it is no regular file (a device has no end) or larger than `most` bytes."""
    path = path_of(path)
    path.stat()  # says why, if there is none
    if not path.is_file():
        raise OSError(errno.EINVAL, "it must be a regular file", str(path))
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it must have at most {most} bytes", str(path))
    return data


def read_text(path: str | Path) -> str:
    """The text of a file in UTF-8, without the mark that spreadsheets put first; OSError as `read_bytes`."""
    return read_bytes(path, LARGEST_TEXT).decode("utf-8-sig")


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name beside it and rename it: it is whole or it is not there."""
    write_together({path: content})


def write_together(files: Mapping[Path, bytes | str]) -> None:
    """Write files that belong together: those that are there at any moment are all whole and of the same writing.
    All are written under temporary names first, so that a full disk leaves the files of before. In an object store they
    are written in their order, each whole; readers there compare the checksum that the last one names. OSError if a
    file cannot be written; the message names it."""
    if any(map(is_remote, files)):
        for path, content in files.items():
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        return
    written: dict[Path, Path] = {}
    try:
        for path, content in files.items():
            with naming(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
                written[path] = Path(temporary)
                with os.fdopen(handle, "wb") as file:
                    file.write(content.encode() if isinstance(content, str) else content)
                    file.flush()
                    os.fsync(file.fileno())
                os.chmod(temporary, 0o644)
        replace_together({temporary: path for path, temporary in written.items()})
    finally:
        for temporary in written.values():
            temporary.unlink(missing_ok=True)


def replace_together(moves: Mapping[Path, Path], gone: Iterable[Path] = ()) -> None:
    """Rename files, old name to new, so that those with the new names are at any moment of one set.
    `moves`: old path -> new path. `gone`: files of the set before that the new one does not have; they are removed."""
    others = [*list(moves.values())[1:], *gone]
    aside = {path: path.with_name(f".{path.name}.before") for path in others if path.exists()}
    placed = False
    try:
        for path, hidden in aside.items():
            with naming(path):
                os.replace(path, hidden)
        for old, new in moves.items():
            with naming(new):
                os.replace(old, new)
            placed = True
    finally:
        for path, hidden in aside.items():
            if hidden.exists() and not placed:
                os.replace(hidden, path)
            hidden.unlink(missing_ok=True)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the system name the path that was meant."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


# ---- One run at a time writes a result: a lock file beside it names the process and the computer that do ----

HELD_BY_OTHERS = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)  # of the file system
_held: set[tuple[Path, int]] = set()


@contextlib.contextmanager
def one_writer(path: Path) -> Iterator[None]:
    """Hold the lock of a result, in `.NAME.lock` beside it, while it is written.
    The system lets go of the lock when a process ends, however it ends: a lock file that was left by one hinders
    nobody. What this thread holds already it may hold again. Object stores have no locks. ValueError if another run
    writes it; the message names its process and computer."""
    key = (path.absolute() if not is_remote(path) else Path(), threading.get_ident())
    if is_remote(path) or key in _held:
        yield
        return
    lock = path.with_name(f".{path.name}.lock")
    new = [folder for folder in lock.parents if not folder.exists()]
    try:
        with naming(lock):
            lock.parent.mkdir(parents=True, exist_ok=True)
            file = _taken(path, lock)
        _held.add(key)
        try:
            yield
        finally:
            _held.discard(key)
            with contextlib.suppress(OSError):  # Windows keeps the file
                lock.unlink()
            file.close()
    finally:
        with contextlib.suppress(OSError):  # those that something was written to stay
            for folder in new:
                folder.rmdir()


def _taken(path: Path, lock: Path) -> IO[str]:
    """The open lock file, which names this process."""
    while True:
        file = lock.open("a+", encoding="utf-8")
        try:
            _take(file)
        except OSError as error:
            if error.errno not in HELD_BY_OTHERS:
                file.close()
                raise
            file.seek(0)
            owner = file.read() or "another run"
            file.close()
            raise ValueError(
                f"{path} must be written by one run at a time, got one beside {owner}: wait until that is done, or "
                "choose another folder"
            ) from None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.stat()):  # else its holder has just removed it
                try:
                    file.truncate(0)
                    file.write(f"process {os.getpid()} on {platform.node()}")
                    file.flush()
                except OSError:  # a full disk
                    lock.unlink()
                    with contextlib.suppress(OSError):
                        file.close()
                    raise
                return file
        file.close()


def _take(file: IO[str]) -> None:
    """Lock an open file; OSError if another holds it."""
    if fcntl is None:
        import msvcrt

        file.seek(2**20)  # beyond the text, which others read
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        return
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        warnings.warn(f"{file.name}: the file system has no locks, two runs at once are not told", stacklevel=4)
