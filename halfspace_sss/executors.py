"""Where the independent parts of a long work run: one after another here, in processes, or on the workers of Dask.

Long work takes a `concurrent.futures.Executor`; without one its parts run in this process. A part is named by what it
depends on and writes its result whole or not at all, so that it may be lost, or run twice, anywhere.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from graphlib import CycleError, TopologicalSorter
from heapq import heappop, heappush
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, TypeVar

import halfspace_sss
from halfspace_sss.backend import BackendError, cores, limit_threads
from halfspace_sss.checks import check_count, check_interval

if TYPE_CHECKING:
    from distributed import Worker

R = TypeVar("R")
LOCAL = "local"  # in place of an address: a cluster of Dask on this machine
MOST_WORKERS = 1024
_PROCESS = os.getpid()  # that imported this module: a forked child has another one


def completed(
    executor: Executor | None,
    function: Callable[..., R],
    parts: Mapping[str, Sequence[object]],
    needs: Mapping[str, Collection[str]] | None = None,
    most: int | None = None,
) -> Iterator[tuple[str, R]]:
    """Name and result of each part, in the order in which they end.

    Args:
        executor: where they run; None: here, one after another, each when it is asked for.
        function: at the top of a module; called with the arguments of a part.
        parts: arguments by the name that errors tell; of those that can run the first are started first.
        needs: names of the parts that must have ended before a part starts; names that are not parts are there.
        most: parts that the executor is given at a time; all that can run by default.

    Raises:
        ValueError: from a part, with its name; parts need each other in a circle, or would run in a forked process,
            where Dr.Jit hangs.
        BackendError: a worker ended.
    """
    order = TopologicalSorter({name: parts.keys() & set((needs or {}).get(name, ())) for name in parts})
    try:
        order.prepare()
    except CycleError as error:
        raise ValueError(f"parts must not need each other in a circle, got {', '.join(error.args[1][:-1])}") from None
    names, ready = list(parts), []
    places = {name: k for k, name in enumerate(names)}
    most = 1 if executor is None else most or len(names)
    futures: dict[Future, str] = {}
    ended: SimpleQueue[Future] = SimpleQueue()

    def started(name: str) -> Future:
        if executor is not None:
            return executor.submit(_part, function, parts[name])
        here: Future = Future()
        with _naming(name):
            here.set_result(function(*parts[name]))
        return here

    try:
        while order.is_active():
            for name in order.get_ready():
                heappush(ready, places[name])
            while ready and len(futures) < most:
                name = names[heappop(ready)]
                futures[future := started(name)] = name
                future.add_done_callback(ended.put)
            with _naming(name := futures.pop(future := ended.get())):
                result = future.result()
            order.done(name)
            yield name, result
    finally:
        for future in futures:
            future.cancel()


@contextmanager
def workers(number: int) -> Iterator[Executor]:
    """Processes of this machine that share its cores evenly; started by spawn, and ended with this process.

    Args:
        number: of processes.

    Raises:
        ValueError: the number is not in [1, MOST_WORKERS].
    """
    check_count("workers", number, 1)
    check_interval("workers", number, 1, MOST_WORKERS)
    threads = max(cores() // number, 1)
    context = multiprocessing.get_context("spawn")
    before = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(number, context, _begin, (threads,))
    try:
        yield executor
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def scheduler(address: str, say: Callable[[str], object] | None = None) -> Iterator[Executor]:
    """The workers of a Dask scheduler.

    Args:
        address: as tcp://HOST:8786, or the file that `dask scheduler --scheduler-file` writes; "local": of a cluster on
            this machine, one worker for each core, that ends with the block.
        say: called with a line that tells where Dask's dashboard is, if there is one.

    Raises:
        BackendError: Dask is not installed, or no scheduler answers.
        ValueError: a worker has another version of this package, or several threads.
    """
    try:
        from distributed import Client, KilledWorker, LocalCluster
        from distributed.diagnostics.plugin import WorkerPlugin
    except ModuleNotFoundError as error:
        raise BackendError(f'a scheduler needs {error.name}: pip install "halfspace-sss[cluster]"') from error

    class WorkerSetUp(WorkerPlugin):
        """What every worker does before its first part."""

        name, version = "halfspace-sss", halfspace_sss.__version__

        def setup(self, worker: Worker) -> None:
            _set_up(worker, self.version)

    with ExitStack() as stack:
        if address == LOCAL:
            cluster = LocalCluster(n_workers=cores(), threads_per_worker=1, dashboard_address="127.0.0.1:0")
            address = stack.enter_context(cluster).scheduler_address
        where = {"scheduler_file": address} if Path(address).is_file() else {"address": address}
        try:
            client = stack.enter_context(Client(**where, timeout=10, set_as_default=False))
        except (OSError, ValueError) as error:
            raise BackendError(f"no scheduler answers at {address}: {error}") from error
        if say and client.dashboard_link:
            say(f"dashboard of Dask: {client.dashboard_link}")
        client.register_plugin(WorkerSetUp())
        try:
            yield client.get_executor(pure=False)
        except KilledWorker as error:
            raise BackendError(f"workers ended again and again under one part: {error}") from error


def _set_up(worker: Worker, version: str) -> None:
    """Refuse workers that would give other numbers or hang, and give the others the threads of OMP_NUM_THREADS.
    Dask gives each worker OMP_NUM_THREADS = 1 unless its configuration says another number."""
    if halfspace_sss.__version__ != version:
        raise ValueError(f"worker {worker.name} must have halfspace-sss {version}, got {halfspace_sss.__version__}")
    if worker.state.nthreads != 1:
        raise ValueError(
            f"worker {worker.name} must run one part at a time (--nthreads 1, OMP_NUM_THREADS for the threads of a "
            f"part), got {worker.state.nthreads} threads"
        )
    limit_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))


def _begin(threads: int) -> None:
    """First of all in a worker: its parent hears of interrupts, and its parent's end is its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    limit_threads(threads)


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)


def _part(function: Callable[..., R], arguments: Sequence[object]) -> R:
    if os.getpid() != _PROCESS:
        raise ValueError(
            "executor must start its processes by spawn, got a forked one, in which Dr.Jit hangs: "
            "ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn'))"
        )
    return function(*arguments)


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """What a part says is told with its name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    except (BrokenExecutor, CancelledError) as error:
        raise BackendError(f"{name}: a worker or the scheduler ended; parts that were done are kept") from error
    except Exception as error:
        if hasattr(error, "add_note"):  # from Python 3.11 on
            error.add_note(f"in part {name}")
        raise
