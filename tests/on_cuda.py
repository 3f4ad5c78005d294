"""What tests of the CUDA backend share: whether it runs here, and the same question asked of both backends."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from halfspace_sss.backend import BackendError, prepare_llvm

CUDA, LLVM = "cuda_ad_rgb", "llvm_ad_rgb"
LOST = "ray tracing operation"  # in what Dr.Jit says where it turns rays off


def why_not() -> str:
    """Why nothing can be compared here; empty where it can."""
    try:
        prepare_llvm()
        import drjit as dr
        import mitsuba as mi
    except (ImportError, BackendError) as error:
        return str(error)
    if not dr.has_backend(dr.JitBackend.CUDA):
        return "Dr.Jit finds no CUDA device"
    try:
        mi.set_variant(CUDA)
        ball = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
        return "" if ball.ray_test(mi.Ray3f([0, 0, -5], [0, 0, 1]))[0] else "OptiX meets nothing"
    except Exception as error:  # whatever a driver without OptiX raises
        return f"OptiX does not run: {error}"


def on(variant: str, ask: Callable[[], Any]) -> Any:
    """What a function answers under a variant, as NumPy arrays."""
    import mitsuba as mi

    import full_geometry

    mi.set_variant(variant)
    full_geometry.register()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # sizes that are beside the point
        found = ask()
    gc.collect()  # scenes of this variant
    return found


def both(ask: Callable[..., Any], *args: tuple) -> tuple[Any, Any]:
    """By CUDA, then by LLVM; what they are asked may differ, as by a seed."""
    there, here = args or ((), ())
    return on(CUDA, lambda: ask(*there)), on(LLVM, lambda: ask(*here))


def agree(image: np.ndarray, reference: np.ndarray, rounding: float = 0.0, z: float = 4.0) -> None:
    """The means over pixels are the same up to z standard errors of the difference and a part of the mean.

    Images are finite, and of different seeds.
    """
    assert np.isfinite(image).all(), f"{(~np.isfinite(image)).sum(axis=(0, 1))} pixels are not finite"
    off = (image - reference).reshape(-1, image.shape[-1])
    error = off.std(axis=0, ddof=1) / np.sqrt(len(off))
    bound = z * error + rounding * np.abs(reference.reshape(off.shape).mean(axis=0))
    assert np.all(np.abs(off.mean(axis=0)) <= bound), (off.mean(axis=0), error, reference.mean(axis=(0, 1)))
    assert np.all(error < 0.02 * np.abs(reference).max()), (error, np.abs(reference).max())  # it can fail
