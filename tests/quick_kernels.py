"""Kernels of tests, compiled in a quarter of the time and kept apart from those of users."""

from __future__ import annotations

import ctypes
import mmap
import os
from pathlib import Path

FOLDER = Path.home() / ".drjit" / "of_tests"


def keep_apart() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("DRJIT_CACHE_DIR", str(FOLDER))


# What LLVM leaves out: optional passes, the order of instructions, registers beyond blocks, folding of patterns
OPTIONS = (
    "-opt-bisect-limit=0", "-opt-bisect-verbose=false", "-regalloc=fast", "-pre-RA-sched=linearize",
    "-combiner-disabled", "-disable-lsr", "-disable-cgp", "-disable-machine-cse", "-disable-machine-licm",
    "-disable-machine-sink", "-disable-peephole", "-disable-copyprop", "-disable-early-ifcvt",
)  # fmt: skip


def compile_quickly() -> None:
    """Where kernels are kept apart: LLVM skips what it can.

    Results are the same but for rounding; walks take up to 40 % longer, which is less than that saves.
    """
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    if path and Path(os.environ.get("DRJIT_CACHE_DIR", "")).name == FOLDER.name:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as library:
            known = [word for word in OPTIONS if library.find(word.lstrip("-").split("=")[0].encode()) >= 0]
        words = (ctypes.c_char_p * (len(known) + 1))(b"tests", *(word.encode() for word in known))
        ctypes.CDLL(path).LLVMParseCommandLineOptions(len(words), words, None)
