"""What every worker of Dask does before its first part; needs the extra `cluster`."""

from __future__ import annotations

import os

from distributed import Worker
from distributed.diagnostics.plugin import WorkerPlugin

import halfspace_sss
from halfspace_sss.backend import limit_threads


class WorkerSetUp(WorkerPlugin):
    """Refuses workers that would give other numbers or hang, and gives the others the threads of OMP_NUM_THREADS.

    Dask gives each worker OMP_NUM_THREADS = 1 unless its configuration says another number.

    Args:
        version: of this package, which workers must have.
    """

    name = "halfspace-sss"

    def __init__(self, version: str) -> None:
        self.version = version

    def setup(self, worker: Worker) -> None:
        """ValueError names a worker of another version, or one that would run several parts at a time."""
        if halfspace_sss.__version__ != self.version:
            raise ValueError(
                f"worker {worker.name} must have halfspace-sss {self.version}, got {halfspace_sss.__version__}"
            )
        if worker.state.nthreads != 1:
            raise ValueError(
                f"worker {worker.name} must run one part at a time (--nthreads 1, OMP_NUM_THREADS for the threads "
                f"of a part), got {worker.state.nthreads} threads"
            )
        limit_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
