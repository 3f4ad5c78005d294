"""One run at a time writes a result: a lock file beside it names the process and the computer that do."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from halfspace_sss.provenance import is_remote, naming

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

HELD_BY_OTHERS = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)  # of the file system
_held: set[tuple[Path, int]] = set()


@contextlib.contextmanager
def one_writer(path: Path) -> Iterator[None]:
    """Hold the lock of a result, in `.NAME.lock` beside it, while it is written.

    The system lets go of the lock when a process ends, however it ends: a lock file that was left by one hinders
    nobody. What this thread holds already it may hold again. Object stores have no locks.

    Raises:
        ValueError: another run writes it; the message names its process and computer.
    """
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
