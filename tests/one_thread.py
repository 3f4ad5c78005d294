"""One thread of Dr.Jit where tests run side by side: further ones spin between launches, on cores of other tests."""

from __future__ import annotations

import ctypes
from pathlib import Path

_empty = ctypes.create_string_buffer(64)  # a pool of OpenEXR without threads, kept for good


def work_in_one_thread() -> None:
    """Give Dr.Jit and OpenEXR the thread of the caller alone, where Mitsuba has OpenEXR 2.5 as an ELF library.

    Mitsuba hands the work of OpenEXR to threads of Dr.Jit beside the caller's, and waits forever if there is none: a
    pool without threads does it at once.
    """
    import drjit as dr
    import mitsuba as mi

    from figures.parts import runner
    from full_geometry import plugins

    for path in Path(mi.__file__).parent.glob("libIlmThread*.so"):
        library, pool = ctypes.CDLL(str(path)), "_ZN13IlmThread_2_510ThreadPool"  # its layout is that of OpenEXR 2.5
        shared, make = (getattr(library, pool + name, None) for name in ("16globalThreadPoolEv", "C1Ej"))
        if shared is None or make is None:
            return
        shared.restype, make.argtypes = ctypes.POINTER(ctypes.c_void_p), [ctypes.c_void_p, ctypes.c_uint]
        make(_empty, 0)
        shared()[1] = ctypes.cast(_empty, ctypes.POINTER(ctypes.c_void_p))[1]  # what stands after its virtual table
        for module in (plugins, runner):
            module.two_threads = lambda: None  # which EXR files need no longer
        dr.set_thread_count(1)
