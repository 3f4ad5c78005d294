"""Models whose BSSRDF depends on position through the distance alone: a profile between two Fresnel factors."""

from __future__ import annotations

import abc
import math
from typing import Any

from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.interface.query import Query
from halfspace_sss.physics.fresnel import C_phi

__all__ = ["Separable", "exit_normaliser"]


def exit_normaliser(eta: float) -> float:
    """∫ T_21(w) cos(theta) dw / pi = 4 C_phi(1/eta): what the exit lobe T_21/pi lacks to unit flux.

    Source: d'Eon 2012.
    """
    return 4 * C_phi(1 / eta)


class Separable(BSSRDF):
    """S = T_12(mu_i) R_d(r) T_21(mu_o) / (pi N) with the exit normaliser N of the model.

    A model gives `R_d`, the radiant exitance per flux that enters, in 1/mfp² for distances in mean free paths.
    """

    reciprocal = True

    @abc.abstractmethod
    def R_d(self, q: Query) -> Any:
        """Radial exitance profile in 1/mfp², for q.r in mean free paths."""

    @property
    @abc.abstractmethod
    def N(self) -> float:
        """Exit normaliser: 1 as in Jensen et al. 2001, or `exit_normaliser(eta)`, which conserves the flux."""

    def G(self, q: Query) -> Any:
        return self.R_d(q) / q.constant(math.pi * self.N)
