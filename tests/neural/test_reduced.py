"""Two networks for all albedos against the network of each."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.neural.reduced import ReducedNetworks
from halfspace_sss.neural.universal import Neural
from halfspace_sss.physics.backbone import backbone_shape

pytest.importorskip("drjit")
import drjit as dr  # noqa: E402
from drjit.llvm import Float  # noqa: E402

from halfspace_sss.arrays import broadcast_query  # noqa: E402
from halfspace_sss.interface.model import Query  # noqa: E402

ALBEDOS = np.linspace(0.6, 0.99, 9)
G, ETA, N = 0.3, 1.4, 4096


def _models() -> list[Neural]:
    return [Neural(Medium.from_albedo(float(a), 1.0, G, ETA)) for a in ALBEDOS]


@pytest.mark.slow
def test_reduced_networks_have_the_S_of_each_albedo() -> None:
    """Sums over distances and directions to 1 %, of magnitudes of the difference to 3 %."""
    models, u = _models(), np.random.default_rng(5).uniform(size=(5, N)).astype(np.float32)
    r = np.exp(np.log(0.02) + np.log(500) * u[0])
    angles = [np.sqrt(u[1]), 2 * np.pi * (u[2] - 0.5), np.sqrt(u[3]), 2 * np.pi * (u[4] - 0.5)]
    lib, args = broadcast_query(Float(r), *(Float(v) for v in angles))
    q, reduced = Query(lib, *args, ETA), ReducedNetworks(models)
    phi = np.array([np.array(v) for v in reduced.functions(q)])
    for model, c in zip(models, reduced.coefficients):
        albedo = float(model.medium.albedo)
        S = np.array(model.eval(*args))
        backbone = np.array(backbone_shape(q.r, albedo, G, ETA))
        T = S / np.maximum(np.array(model.G(q)), 1e-30)
        found = T * albedo**2 * backbone * np.exp(phi[0] + c @ phi[1:])
        weight = r * r
        assert abs((weight * (found - S)).sum()) < 0.01 * (weight * S).sum()
        assert (weight * np.abs(found - S)).sum() < 0.03 * (weight * S).sum()
    dr.sync_thread()


def test_reduced_networks_are_the_same_each_time() -> None:
    one, two = (ReducedNetworks(_models()) for _ in range(2))
    assert np.array_equal(one.coefficients, two.coefficients)


def test_media_with_derivatives_are_refused_by_name() -> None:
    g = pytest.importorskip("torch").tensor(G, requires_grad=True)
    with pytest.raises(ValueError, match="medium must be of numbers"):
        ReducedNetworks([Neural(Medium.from_albedo(0.6, 1.0, g, ETA))])
