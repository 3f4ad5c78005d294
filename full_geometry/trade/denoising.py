"""Images without their noise, by Open Image Denoise, and what leads it: albedo and normals."""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from full_geometry.trade.image_differences import check_image
from halfspace_sss.backend import clock, needed

if TYPE_CHECKING:
    import mitsuba as mi

GUIDE_SPP = 32  # twice as many take another second at 512 x 512, for 1 to 2 % less error where there are textures
MARGIN = 32  # pixels around surfaces that the denoiser sees too
GUIDES = "albedo:albedo,n:sh_normal"  # of the integrator `aov`


def check_denoiser() -> ModuleType:
    """The package `mitsuba_oidn`; BackendError with what to install where there is none."""
    return needed("mitsuba_oidn", "denoising needs mitsuba-oidn", "figures")


def cover(scene: mi.Scene, spp: int = GUIDE_SPP) -> np.ndarray:
    """Share of each pixel that objects cover, (H, W), float32."""
    return _cover(_aovs(scene, "n:sh_normal", spp, 0))


def guides(scene: mi.Scene, sensor: mi.Sensor | int = 0, spp: int = GUIDE_SPP) -> tuple[np.ndarray, np.ndarray]:
    """Mean albedo of each pixel (H, W, 3) and mean shading normal (H, W, 3), both float32.
    The albedo of translucent objects is their directional albedo. Where there is none at all, as of mirrors and glass,
    it is the cover of the pixel, as Open Image Denoise asks."""
    return guides_of(_aovs(scene, GUIDES, spp, sensor))


def guides_of(aovs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same from an image of `GUIDES`."""
    albedo, normal = np.clip(aovs[..., :3], 0, 1), aovs[..., 3:6]
    return np.where(albedo.any(axis=2, keepdims=True), albedo, _cover(normal)[..., None]), np.clip(normal, -1, 1)


def _aovs(scene: mi.Scene, aovs: str, spp: int, sensor: mi.Sensor | int) -> np.ndarray:
    import mitsuba as mi

    integrator = mi.load_dict({"type": "aov", "aovs": aovs})
    return np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=7), dtype=np.float32)


def _cover(normal: np.ndarray) -> np.ndarray:
    return np.clip(np.linalg.norm(normal[..., :3], axis=2), 0, 1)


def without_noise(name: str, guide: np.ndarray) -> np.ndarray:
    """A guide, "albedo" or "normal", (H, W, 3), without its own noise: of textures, edges, and depth of field."""
    oidn = check_denoiser()
    # arrays of the host, which a GPU need not reach
    prefilter = oidn.Device(oidn.DeviceType.CPU).new_filter("RT")
    guide = np.ascontiguousarray(guide, dtype=np.float32)
    result = np.empty_like(guide)
    prefilter.set_image(name, guide)
    prefilter.set_image("output", result)
    prefilter.quality = oidn.Quality.Balanced
    prefilter.execute()
    return result


def clean_guides(found: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """Albedo and normals without their noise."""
    return [without_noise(*each) for each in zip(("albedo", "normal"), found)]


def denoised(
    image: np.ndarray, albedo: np.ndarray, normal: np.ndarray, clean: bool = False, quick: bool = False
) -> tuple[np.ndarray, float]:
    """The image without its noise, float32, and the seconds it took.

    Args:
        image: linear radiance (H, W, 3).
        albedo, normal: as `guides` makes them.
        clean: whether these have no noise, so that their detail is kept.
        quick: whether the network for clean guides is the smaller one, of half the time. It suits precomputed light,
            where the larger one lowers errors by 0 to 5 %, and keeps noise of sampled walks under even light.

    Raises:
        ValueError: the image is not finite or below 0, or the sizes differ.
        BackendError: the denoiser is not installed.
    """
    oidn, pixels = check_denoiser(), check_image("image", image)
    for name, guide in (("albedo", albedo), ("normal", normal)):
        if np.shape(guide) != pixels.shape:
            raise ValueError(f"{name} must have the shape of the image {pixels.shape}, got {np.shape(guide)}")
    albedo, normal = (np.ascontiguousarray(guide, dtype=np.float32) for guide in (albedo, normal))
    quality = oidn.Quality.Balanced if quick else oidn.Quality.High
    started = clock()
    result = oidn.denoise(pixels, albedo=albedo, normal=normal, hdr=True, clean_aux=clean, quality=quality)
    return np.maximum(np.asarray(result), 0.0), clock() - started


class Denoiser:
    """A denoiser of renders of a scene, led by its albedo and normals.
    `sensor`: of Mitsuba, or its number. `integrator`: that renders; None for the one of the scene. `spp`: samples of
    albedo and normals. `clean`: whether these lose their noise first, which takes as long as two images. BackendError
    if the denoiser is not installed."""

    def __init__(
        self, scene: mi.Scene, sensor: mi.Sensor | int = 0, integrator: mi.Integrator | None = None,
        spp: int = GUIDE_SPP, clean: bool = True,
    ) -> None:  # fmt: skip
        from full_geometry.integrators.translucent_walk import precomputes_light

        check_denoiser()
        integrator = integrator or scene.integrator()
        found = guides(scene, sensor, spp)
        self._surface = np.any(found, axis=(0, 3))
        self._box, self._clean = _box_around(self._surface), clean
        boxed = tuple(guide[self._box] for guide in found)
        self._guides = clean_guides(boxed) if clean else boxed
        self._layered = bool(getattr(integrator, "layers", False))
        self._quick = clean and precomputes_light(integrator, scene)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """The colours (H, W, 3) without noise; a layer of emission stays as it is: edges of lamps in mirrors are sharp.
        So do pixels without a surface, into which objects would shine.
        `image`: linear radiance (H, W, channels), the last three the emission if the integrator has that layer and
        there are more than three."""
        # filters with negative lobes go below 0
        light = np.maximum(image[..., :3] if image.shape[2] >= 3 else image[..., :1].repeat(3, axis=2), 0.0)
        emission = np.clip(image[..., -3:], 0.0, light) if self._layered and image.shape[2] > 3 else 0.0
        rest = (light - emission).astype(np.float32)
        found = denoised(rest[self._box], *self._guides, clean=self._clean, quick=self._quick)[0]
        rest[self._box] = np.where(self._surface[self._box][..., None], found, rest[self._box])
        return rest + emission


def _box_around(surface: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the pixels that show a surface, and `MARGIN` more on each side; a corner where none does."""
    found = []
    for axis in (1, 0):
        lit = np.flatnonzero(surface.any(axis=axis))
        first, last = (int(lit[0]), int(lit[-1]) + 1) if len(lit) else (0, 0)
        found.append(slice(max(first - MARGIN, 0), last + MARGIN))
    return tuple(found)
