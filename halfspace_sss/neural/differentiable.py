"""The universal model with the medium as Dr.Jit arrays: gradients with respect to it, for inverse problems."""

from __future__ import annotations

import numpy as np

from halfspace_sss.arrays import Lanes, broadcast_query, is_torch, library
from halfspace_sss.interface.query import Query
from halfspace_sss.lazy import LazyModule
from halfspace_sss.neural.network import N_TERMS, log_calibrations, medium_features, symmetric_features, travel
from halfspace_sss.neural.perceptron import Perceptron, cooperative, silu
from halfspace_sss.neural.universal import Hypernetwork, Layers, load_hypernetwork, shipped_weights
from halfspace_sss.physics.backbone import backbone_shape, length_scale
from halfspace_sss.physics.fresnel import F_t

dr = LazyModule("drjit")


def neural_S(
    sigma_t: Lanes, albedo: Lanes, g: Lanes, eta: Lanes,
    r: Lanes, mu_i: Lanes, phi_i: Lanes, mu_o: Lanes, phi_o: Lanes,
) -> Lanes:  # fmt: skip
    """S of order >= 2 of the model `neural` in 1/(mm² sr), differentiable in all arguments, by Dr.Jit.

    With torch, give `Medium` tensors that require gradients instead.

    On CUDA, Dr.Jit evaluates the layers, and adds up their derivatives, in half precision.

    Args:
        sigma_t: extinction, 1/mm; one number as a Dr.Jit array, as the next three.
        albedo, g, eta: of the medium, inside the ranges of `neural` (not checked: they may be traced).
        r, mu_i, phi_i, mu_o, phi_o: query as in `BSSRDF.eval`, Dr.Jit arrays.

    Raises:
        ValueError: the arrays are of another library.
    """
    medium, query = (sigma_t, albedo, g, eta), (r, mu_i, phi_i, mu_o, phi_o)
    lib = library(*medium, *query)
    if lib is library(0.0) or is_torch(lib):
        raise ValueError(
            f"sigma_t must be a Dr.Jit array, got {type(sigma_t).__name__}; use bssrdf('neural', medium).eval"
        )
    _, (r, mu_i, phi_i, mu_o, phi_o) = broadcast_query(*query)
    hyper = load_hypernetwork(shipped_weights())
    L = length_scale(albedo, g)
    c = medium_features(lib, albedo, g, eta, L)
    q = Query(lib, sigma_t * r, mu_i, phi_i, mu_o, phi_o, eta)
    features = symmetric_features(lib, q.r, *travel(q), L)
    factor = lib.exp(_network(hyper, c, features) + log_calibrations(_terms(hyper, c, q.r), q))
    G = albedo * albedo * (backbone_shape(q.r, albedo, g, eta) * factor)
    return sigma_t * sigma_t * F_t(mu_i, eta) * F_t(mu_o, eta) * G


def _terms(hyper: Hypernetwork, c: list, like: Lanes) -> list:
    """Coefficients of `log_calibration`."""
    kind = type(like)
    h = _layered(hyper.calibration_layers, c, kind).array
    index = dr.uint32_array_t(kind)
    return [dr.gather(kind, h, index(k)) for k in range(N_TERMS)]


def _layered(layers: Layers, c: list, kind: type) -> Lanes:
    h = dr.tensor_t(kind)(dr.concat([kind(v) for v in c]), (1, len(c)))
    for k, (W, b) in enumerate(layers):
        h = h @ _tensor(W, kind) + _tensor(b[None], kind)
        if k < len(layers) - 1:
            h = h / (1 + dr.exp(-h))
    return h


def _tensor(array: np.ndarray, kind: type) -> Lanes:
    return dr.tensor_t(kind)(np.ascontiguousarray(array, np.float32))


def _network(hyper: Hypernetwork, c: list, features: list) -> Lanes:
    from drjit import nn

    kind = type(sum(features[1:], features[0]))
    tensor = dr.tensor_t(kind)
    h = _layered(hyper.medium_layers, c, kind)
    numbers, at, parts = (_tensor(hyper.base[None], kind) + h @ _tensor(hyper.basis, kind)).array, 0, []
    for i, j in hyper.shapes:
        transposed = (np.arange(i * j).reshape(i, j).T + at).ravel()
        index = dr.uint32_array_t(kind)
        parts.append(tensor(dr.gather(kind, numbers, index(transposed)), (j, i)))
        parts.append(dr.gather(kind, numbers, index(np.arange(j) + at + i * j)))
        at += i * j + j
    zero = dr.zeros(kind, max(dr.width(f) for f in features))  # cooperative vectors do not sum over what they broadcast
    x = cooperative([f + zero for f in features])
    parts = [(dr.tensor_t(x.type) if k % 2 == 0 else x.type)(part) for k, part in enumerate(parts)]
    views = nn.pack(*parts, layout="training")[-len(parts) :]
    for k in range(len(hyper.shapes)):
        x = nn.matvec(views[2 * k], x, views[2 * k + 1])
        x = silu(x) if k < len(hyper.shapes) - 1 else x
    return Perceptron.numbers(x)[0]
