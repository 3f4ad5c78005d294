"""A denoised render and its total error: each half of the samples is denoised alone and held to the other half.

With A and B the means of independent halves of the samples, V_A and V_B their variances, L the image without noise and
D a denoiser, B has no bias and is independent of D(A):

    E[(D(A) - B)²] = e_A² + V_B,    e_A² = E[(D(A) - L)²].

So P = (1 - s) D(A) + s B and Q = (1 - s) D(B) + s A have the errors (1 - s)² e_A² + s² V_B and (1 - s)² e_B² + s² V_A,
which s = e² / (e² + V), of the sums over the image, makes least. The image (P + Q) / 2, which comes to L with the
samples as the denoiser gives way, has the mean squared error

    e² = E[(P - L)² + (Q - L)²] / 2 - E[(P - Q)²] / 4,

with the bias of the denoiser in it. A bias of what is denoised, as that of precomputed light, is not in it. Rousselle,
Knaus and Zwicker (2012) hold the halves of a render to each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from full_geometry.scenes.reference_store import Reference

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

    @property
    def share(self) -> float:
        """The share s of the noisy halves beside the denoised ones."""
        e, V = max(float(np.sum(self.held())), 0.0), float((self.V_A + self.V_B).sum())
        return e / (e + V) if e + V > 0 else 0.0

    def held(self) -> tuple[np.ndarray, np.ndarray]:
        """Estimates of e_A² and e_B² of the pixels, (H, W, 3): each denoised half held to the other."""
        return (self.D_A - self.B) ** 2 - self.V_B, (self.D_B - self.A) ** 2 - self.V_A

    def mixed(self, s: float) -> tuple[np.ndarray, np.ndarray]:
        """P and Q."""
        return (1 - s) * self.D_A + s * self.B, (1 - s) * self.D_B + s * self.A

    def squared(self, s: float) -> tuple[np.ndarray, float]:
        """Estimates of e² of the pixels, (H, W, 3), and the part of their sum that is noise, not bias."""
        (e_A, e_B), (P, Q), V = self.held(), self.mixed(s), self.V_A + self.V_B
        noise = 0.25 * ((1 - s) ** 2 * np.square(self.D_A - self.D_B).sum() + s**2 * V.sum())
        return 0.5 * ((1 - s) ** 2 * (e_A + e_B) + s**2 * V) - 0.25 * (P - Q) ** 2, float(noise)


def cross_denoised(found: Reference, denoise: Denoise) -> Denoised:
    """The mean of both denoised halves of a render; all of it denoised where no halves are known.

    Args:
        found: with its half.
        denoise: a denoiser, as `trade.denoising.Denoiser`.
    """
    if found.half is None or found.passes < 2:
        return Denoised(denoise(found.mean), math.inf, math.inf)
    halves = Halves.of(found, denoise)
    s = halves.share
    P, Q = halves.mixed(s)
    squared, noise = halves.squared(s)
    squared = squared.sum(axis=2).ravel()
    whole = max(float(np.square(found.mean[..., :3]).sum() - found.variance[..., :3].sum()), 1e-30)
    error = math.sqrt(max(float(squared.sum()), noise) / whole)
    spread = math.sqrt(squared.size) * float(squared.std()) / whole
    return Denoised(0.5 * (P + Q), error, spread / (2 * max(error, math.sqrt(spread), 1e-15)))
