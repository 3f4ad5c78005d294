"""What the two small learnt models share: S = T_12 T_21 B(r) exp(network of symmetric features) a(mu_i) a(mu_o)."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence

from halfspace_sss.arrays import Real
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.interface.query import Query
from halfspace_sss.neural.features import symmetric_features, travel
from halfspace_sss.neural.hypernetwork import log_calibration
from halfspace_sss.neural.network import Network
from halfspace_sss.physics.backbone import backbone_shape, length_scale
from halfspace_sss.physics.medium import Medium

LOG_RANGE = 30.0  # bound of the logarithm of the learnt factor


def log_calibrations(c: Sequence[Real], q: Query) -> Real:
    """log a(mu_i) a(mu_o) of a query, see `log_calibration`."""
    return log_calibration(c, q.mu_i, q.mu_i_in) + log_calibration(c, q.mu_o, q.mu_o_in)


def factored_G(network: Network, q: Query, albedo: Real, g: Real, eta: Real, calibration: Sequence[float] = ()) -> Real:
    """G = B(r) exp(network(features)) a(mu_i) a(mu_o) of one channel: positive, reciprocal and mirror-invariant.

    `calibration` are the coefficients of log a, see `log_calibration`; without them a is 1.
    """
    lib, L = q.lib, q.constant(length_scale(albedo, g))
    log_factor = network(symmetric_features(lib, q.r, *travel(q), L))
    if len(calibration):
        c = [q.constant(v) for v in calibration]
        log_factor = log_factor + log_calibrations(c, q)
    factor = lib.exp(lib.minimum(lib.maximum(log_factor, -LOG_RANGE), LOG_RANGE))
    return q.constant(albedo * albedo) * (backbone_shape(q.r, albedo, g, eta) * factor)


class SymmetricModel(BSSRDF):
    """A learnt BSSRDF of order >= 2 that is positive, reciprocal and mirror-invariant by construction.

    A model gives `networks`, the small network of each channel of its medium, and may give their `calibrations`.
    """

    orders = "multiple"
    reciprocal = True
    networks: list[Network]
    calibrations: Sequence[Sequence[float]] = ()

    @property
    def checksums(self) -> tuple[str, ...]:
        if not self.calibrations:
            return tuple(network.checksum for network in self.networks)
        pairs = zip(self.networks, self.calibrations)
        return tuple(hashlib.sha256(f"{n.checksum} {tuple(c)}".encode()).hexdigest() for n, c in pairs)

    def G(self, q: Query) -> Real:
        m, calibrations = self.medium, self.calibrations or [()] * len(self.networks)
        if m.n_channels is None:
            return factored_G(self.networks[0], q, m.albedo, m.g, m.eta, calibrations[0])
        parts = zip(self.networks, calibrations, channels(m), channel_queries(q, m))
        return q.lib.stack([factored_G(n, one, c.albedo, c.g, c.eta, calibration) for n, calibration, c, one in parts])


def channel_queries(q: Query, medium: Medium) -> list[Query]:
    """The query of each channel of a medium that has channels."""
    names = ("r", "mu_i", "phi_i", "mu_o", "phi_o")
    columns = {n: getattr(q, n) for n in names}
    return [
        dataclasses.replace(
            q, **{n: v[..., min(k, v.shape[-1] - 1)] for n, v in columns.items()}, r_mm=None, sigma_t=None
        )
        for k in range(medium.n_channels)
    ]


def channels(medium: Medium) -> list[Medium]:
    """The scalar media of the channels."""
    return [medium.channel(k) for k in range(medium.n_channels or 1)]
