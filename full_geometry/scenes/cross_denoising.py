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


def cross_denoised(found: Reference, denoise: Denoise) -> Denoised:
    """The mean of both denoised halves of a render; all of it denoised where no halves are known.

    Args:
        found: with its half.
        denoise: a denoiser, as of `trade.denoising.Denoiser`.
    """
    if found.half is None or found.passes < 2:
        return Denoised(denoise(found.mean), math.inf, math.inf)

    # ---- means and variances of the halves; the variance of one sample is that of the mean times the samples
    n, spp = found.half_spp, found.spp
    A, B = found.half, (spp * found.mean - n * found.half) / (spp - n)
    variance = found.variance[..., :3]
    V_A, V_B = variance * (spp / n), variance * (spp / (spp - n))

    # ---- denoised halves, and their squared errors over the image
    D_A, D_B, A, B = denoise(A), denoise(B), A[..., :3], B[..., :3]
    e_A, e_B = (D_A - B) ** 2 - V_B, (D_B - A) ** 2 - V_A
    e, V = max(float((e_A + e_B).sum()), 0.0), float((V_A + V_B).sum())
    s = e / (e + V) if e + V > 0 else 0.0

    # ---- each with its share of the other half, and what both are off
    P, Q = (1 - s) * D_A + s * B, (1 - s) * D_B + s * A
    squared = 0.5 * ((1 - s) ** 2 * (e_A + e_B) + s**2 * (V_A + V_B)) - 0.25 * (P - Q) ** 2
    squared = squared.sum(axis=2).ravel()
    least = 0.25 * float((1 - s) ** 2 * np.square(D_A - D_B).sum() + s**2 * (V_A + V_B).sum())  # the noise alone
    whole = max(float(np.square(found.mean[..., :3]).sum() - variance.sum()), 1e-30)
    noise = math.sqrt(squared.size) * float(squared.std()) / whole
    error = math.sqrt(max(float(squared.sum()), least) / whole)
    return Denoised(0.5 * (P + Q), error, noise / (2 * max(error, math.sqrt(noise), 1e-15)))
