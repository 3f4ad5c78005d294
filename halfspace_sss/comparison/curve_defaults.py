"""Which distances and how many walks a set of curves takes for a medium, where nothing else is asked."""

from __future__ import annotations

import math

from halfspace_sss.physics.medium import Medium
from halfspace_sss.tracing.tracer import trace

__all__ = ["default_paths", "default_range"]

MOST_MFP = 100.0  # transport mean free paths, end of the range where nothing is absorbed
EVENTS = 360_000_000  # scattering events, those of 64 million walks in the medium of Fig. 10
FEWEST, MOST, PILOT = 250_000, 64_000_000, 4096  # walks


def default_range(medium: Medium) -> tuple[float, float]:
    """Distances (mm) of a curve: 0.012 to 6 transport mean free paths, or to 4/sigma_tr if light gets farther.

    sigma_tr = sqrt(3 sigma_a sigma_t'), at most 100 transport mean free paths; two digits. Fig. 10: 0.05 to 25 mm.
    """
    mfp, sigma_tr = 1 / medium.sigma_t_prime, math.sqrt(3 * medium.sigma_a * medium.sigma_t_prime)
    far = max(6.025 * mfp, min(4 / max(sigma_tr, 1e-300), MOST_MFP * mfp))
    return float(f"{0.01205 * mfp:.2g}"), float(f"{far:.2g}")


def default_paths(medium: Medium, backend: str = "llvm") -> int:
    """Walks that take about as long in any medium: 64 million in Fig. 10, fewer where a walk is longer.

    Events per walk are counted in 4096 walks at normal incidence; at least 250 000 walks, two digits.
    """
    pilot = trace(medium, n_paths=PILOT, seed=0, backend=backend)
    paths = EVENTS * pilot.n_paths / max(pilot.n_events, 1)
    return int(min(max(float(f"{paths:.2g}"), FEWEST), MOST))
