"""Images as OpenEXR with float32 channels, with what they are in the header."""

from __future__ import annotations

import os

import numpy as np

from halfspace_sss.backend import BackendError, two_threads

__all__ = ["exr_bytes", "read_exr"]


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
