"""A denoised render and its total error: each half of the samples is denoised alone and held to the other half.

With A and B the means of independent halves of the samples, V_A and V_B their variances, L the image without noise and
D a denoiser, B has no bias and is independent of D(A):

    E[(D(A) - B)²] = e_A² + V_B,    e_A² = E[(D(A) - L)²].

So s = e² / (e² + V), of the sums over the image, makes the error of (1 - s) D(A) + s B least. Noise falls in means over
pixels, the bias of a denoiser hardly does. A share of its own is therefore that of coarse differences G (B - D(A)), G a
Gaussian filter:

    P = D(A) + K (B - D(A)),    Q = D(B) + K (A - D(B)),    K = s + (s_coarse - s) G.

The image (P + Q) / 2, which comes to L with the samples as the denoiser gives way, has the mean squared error

    e² = E[(P - B)² + (Q - A)² + N² - (A - B - N)²] / 2 - E[(P - Q)²] / 4,    N = K (A - B),

with the bias of the denoiser in it. A bias of what is denoised, as that of precomputed light, is not in it. Rousselle,
Knaus and Zwicker (2012) hold the halves of a render to each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from full_geometry.scenes.reference_store import Reference

COARSE = 3.0  # pixels, standard deviation of the filter
Denoise = Callable[[np.ndarray], np.ndarray]  # an image (H, W, channels) -> its colours without noise (H, W, 3)


class Denoised(NamedTuple):
    """A denoised image.

    Args:
        image: linear radiance (H, W, 3).
        error: sqrt(sum of e² / sum of L²) over pixels and colours; infinite where there are no two halves.
        standard_error: of the error.
    """

    image: np.ndarray
    error: float
    standard_error: float

    @property
    def told(self) -> str:
        """The error as a sentence."""
        if not math.isfinite(self.error):
            return "denoised: one pass has no estimate of its error"
        return f"denoised: {self.error:.2%} ± {self.standard_error:.2%} off, with the bias of the denoiser"


class Halves(NamedTuple):
    """Two halves of the samples, (H, W, 3).

    Args:
        A, B: their means.
        V_A, V_B: variances of these.
        D_A, D_B: both denoised.
    """

    A: np.ndarray
    B: np.ndarray
    V_A: np.ndarray
    V_B: np.ndarray
    D_A: np.ndarray
    D_B: np.ndarray

    @classmethod
    def of(cls, found: Reference, denoise: Denoise) -> Halves:
        """The halves of a render of at least two passes."""
        # the variance of one sample is that of the mean times the samples
        n, spp, variance = found.half_spp, found.spp, found.variance[..., :3]
        A, B = found.half, (spp * found.mean - n * found.half) / (spp - n)
        return cls(A[..., :3], B[..., :3], variance * (spp / n), variance * (spp / (spp - n)), denoise(A), denoise(B))

    def held(self) -> tuple[np.ndarray, np.ndarray]:
        """Estimates of e_A² and e_B² of the pixels, (H, W, 3): each denoised half held to the other."""
        return (self.D_A - self.B) ** 2 - self.V_B, (self.D_B - self.A) ** 2 - self.V_A

    def mixed(self) -> MixedHalves:
        """P, Q and N, by the shares of the noisy halves that make errors least."""
        # ---- differences from the denoised halves, and those of the noise, which cells of light share among pixels
        A, B, noise = self.B - self.D_A, self.A - self.D_B, self.A - self.B
        coarse = [gaussian_filter(x, (COARSE, COARSE, 0)) for x in (A, B, noise)]
        s, s_coarse = (_share(*parts) for parts in ((A, B, noise), coarse))

        # ---- K of each
        P, Q, N = (s * x + (s_coarse - s) * low for x, low in zip((A, B, noise), coarse))
        return MixedHalves(self.D_A + P, self.D_B + Q, N, self.A, self.B)


class MixedHalves(NamedTuple):
    """Halves with their shares of noise, (H, W, 3), as in the head of this module."""

    P: np.ndarray
    Q: np.ndarray
    N: np.ndarray
    A: np.ndarray
    B: np.ndarray

    def means(self, size: int) -> MixedHalves:
        """Over blocks of `size` x `size` pixels; those at the ends that are not whole are left out."""
        n, m = (length // size for length in self.P.shape[:2])
        return MixedHalves(*(x[: n * size, : m * size].reshape(n, size, m, size, -1).mean(axis=(1, 3)) for x in self))

    def squared(self) -> tuple[np.ndarray, float]:
        """Estimates of e² of the pixels, (H, W, 3), and the part of their sum that is noise, not bias."""
        P, Q, N, A, B = self
        apart = (P - Q) ** 2
        result = 0.5 * ((P - B) ** 2 + (Q - A) ** 2 + N**2 - (A - B - N) ** 2) - 0.25 * apart
        # P - Q + N is of the denoised halves alone
        return result, float(0.25 * (np.square(P - Q + N) + N**2).sum())


def _share(A: np.ndarray, B: np.ndarray, noise: np.ndarray) -> float:
    """The share s of noisy halves, for differences of each denoised half from the other and of the noisy ones."""
    V = float(np.square(noise).sum())
    e = max(float(np.square(A).sum() + np.square(B).sum()) - V, 0.0)
    return e / (e + V) if e + V > 0 else 0.0


def cross_denoised(found: Reference, denoise: Denoise) -> Denoised:
    """The mean of both denoised halves of a render; all of it denoised where no halves are known.

    Args:
        found: with its half.
        denoise: a denoiser, as `trade.denoising.Denoiser`.
    """
    if found.half is None or found.passes < 2:
        return Denoised(denoise(found.mean), math.inf, math.inf)
    halves = Halves.of(found, denoise)
    mixed = halves.mixed()
    squared, noise = mixed.squared()
    squared = squared.sum(axis=2).ravel()
    whole = max(float(np.square(found.mean[..., :3]).sum() - found.variance[..., :3].sum()), 1e-30)
    error = math.sqrt(max(float(squared.sum()), noise) / whole)
    spread = math.sqrt(squared.size) * float(squared.std()) / whole
    return Denoised(0.5 * (mixed.P + mixed.Q), error, spread / (2 * max(error, math.sqrt(spread), 1e-15)))
