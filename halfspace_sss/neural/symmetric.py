"""What the two small learnt models share: S = T_12 T_21 B(r) exp(network of symmetric features)."""

from __future__ import annotations

import dataclasses
from typing import Any

from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.interface.query import Query
from halfspace_sss.neural.features import symmetric_features, travel
from halfspace_sss.neural.network import Network
from halfspace_sss.physics.backbone import backbone_shape, length_scale
from halfspace_sss.physics.medium import Medium

__all__ = ["LOG_RANGE", "SymmetricModel", "channel_queries", "channels", "factored_G"]

LOG_RANGE = 30.0  # bound of the logarithm of the learnt factor


def factored_G(network: Network, q: Query, albedo: Any, g: Any, eta: Any) -> Any:
    """G = B(r) exp(network(features)) for a query of one channel: positive, reciprocal and mirror-invariant."""
    lib, L = q.lib, q.constant(length_scale(albedo, g))
    log_factor = network(symmetric_features(lib, q.r, *travel(q), L))
    factor = lib.exp(lib.minimum(lib.maximum(log_factor, -LOG_RANGE), LOG_RANGE))
    return q.constant(albedo * albedo) * (backbone_shape(q.r, albedo, g, eta) * factor)


class SymmetricModel(BSSRDF):
    """A learnt BSSRDF of order >= 2 that is positive, reciprocal and mirror-invariant by construction.

    A model gives `networks`, the small network of each channel of its medium.
    """

    orders = "multiple"
    reciprocal = True
    networks: list[Network]

    @property
    def checksums(self) -> tuple[str, ...]:
        return tuple(network.checksum for network in self.networks)

    def G(self, q: Query) -> Any:
        m = self.medium
        if m.n_channels is None:
            return factored_G(self.networks[0], q, m.albedo, m.g, m.eta)
        parts = zip(self.networks, channels(m), channel_queries(q, m))
        return q.lib.stack([factored_G(network, one, c.albedo, c.g, c.eta) for network, c, one in parts])


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
