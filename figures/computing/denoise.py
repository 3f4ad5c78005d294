"""Open Image Denoise on rendered images, led by the normals of the object that the camera sees."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from figures.computing.tone import check_image
from halfspace_sss.backend import BackendError

__all__ = ["check_denoiser", "denoised", "guides"]

GUIDE_SPP = 64


def check_denoiser() -> Any:
    """The package `mitsuba_oidn`; BackendError with what to install where there is none."""
    try:
        import mitsuba_oidn
    except ImportError as error:
        raise BackendError('denoising needs mitsuba-oidn: pip install "halfspace-sss[figures]"') from error
    return mitsuba_oidn


def guides(scene: Any, spp: int = GUIDE_SPP, sensor: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Cover of each pixel by objects, as an albedo (H, W, 3), and mean shading normal (H, W, 3), both float32.

    What is below a translucent surface has no albedo of its own: covered pixels get 1.
    """
    import mitsuba as mi

    aov = mi.load_dict({"type": "aov", "aovs": "n:sh_normal"})
    normal = np.array(mi.render(scene, integrator=aov, sensor=sensor, spp=spp, seed=7), dtype=np.float32)[..., :3]
    cover = np.clip(np.linalg.norm(normal, axis=2), 0, 1)
    return np.repeat(cover[..., None], 3, axis=2), np.clip(normal, -1, 1)


def denoised(image: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """The image without its noise, float32, and the seconds it took.

    Args:
        image: linear radiance (H, W, 3).
        albedo, normal: as `guides` makes them.

    Raises:
        ValueError: the image is not finite or below 0, or the sizes differ.
        BackendError: the denoiser is not installed.
    """
    oidn, pixels = check_denoiser(), check_image("image", image)
    for name, guide in (("albedo", albedo), ("normal", normal)):
        if np.shape(guide) != pixels.shape:
            raise ValueError(f"{name} must have the shape of the image {pixels.shape}, got {np.shape(guide)}")
    albedo, normal = (np.ascontiguousarray(guide, dtype=np.float32) for guide in (albedo, normal))
    started = time.perf_counter()
    found = oidn.denoise(pixels, albedo=albedo, normal=normal, hdr=True)
    return np.maximum(np.asarray(found), 0.0), time.perf_counter() - started
