"""The universal model with the medium as arrays: gradients with respect to it, for inverse problems."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


import numpy as np

from halfspace_sss.arrays import Lanes, Real, broadcast_query, is_torch, library
from halfspace_sss.interface.query import Query
from halfspace_sss.neural.network import N_TERMS, log_calibrations, medium_features, symmetric_features, travel
from halfspace_sss.neural.perceptron import Perceptron, cooperative, silu
from halfspace_sss.neural.universal import Hypernetwork, Layers, load_hypernetwork, shipped_weights
from halfspace_sss.physics.backbone import backbone_shape, length_scale
from halfspace_sss.physics.fresnel import F_t


def neural_S(
    sigma_t: Real, albedo: Real, g: Real, eta: Real, r: Real, mu_i: Real, phi_i: Real, mu_o: Real, phi_o: Real
) -> Real:
    """S of order >= 2 of the model `neural` in 1/(mm² sr), differentiable in all arguments, torch or Dr.Jit.

    On CUDA, Dr.Jit evaluates the layers, and adds up their derivatives, in half precision.

    Args:
        sigma_t: extinction, 1/mm; one number as a torch tensor or Dr.Jit array, as the next three.
        albedo, g, eta: of the medium, inside the ranges of `neural` (not checked: they may be traced).
        r, mu_i, phi_i, mu_o, phi_o: query as in `BSSRDF.eval`, arrays of the same library.

    Raises:
        ValueError: the arrays are of another library, or of several.
    """
    medium, query = (sigma_t, albedo, g, eta), (r, mu_i, phi_i, mu_o, phi_o)
    lib = library(*medium, *query)
    if lib is library(0.0):
        raise ValueError(
            "sigma_t must be a torch tensor or Dr.Jit array, got numbers; use bssrdf('neural', medium).eval"
        )
    _, (r, mu_i, phi_i, mu_o, phi_o) = broadcast_query(*query)
    hyper = load_hypernetwork(shipped_weights())
    L = length_scale(albedo, g)
    c = medium_features(lib, albedo, g, eta, L)
    q = Query(lib, sigma_t * r, mu_i, phi_i, mu_o, phi_o, eta)
    features = symmetric_features(lib, q.r, *travel(q), L)
    evaluate, layered = (_torch_network, _torch_terms) if is_torch(lib) else (_drjit_network, _drjit_terms)
    factor = lib.exp(evaluate(hyper, c, features) + log_calibrations(layered(hyper, c, q.r), q))
    G = albedo * albedo * (backbone_shape(q.r, albedo, g, eta) * factor)
    return sigma_t * sigma_t * F_t(mu_i, eta) * F_t(mu_o, eta) * G


def _torch_network(hyper: Hypernetwork, c: list, features: list) -> torch.Tensor:
    import torch

    x = torch.stack(torch.broadcast_tensors(*features), dim=-1)
    numbers = _torch(hyper.base, x) + _torch_layers(hyper.medium_layers, c, x) @ _torch(hyper.basis, x)
    at = 0
    for k, (i, j) in enumerate(hyper.shapes):
        x = x @ numbers[at : at + i * j].reshape(i, j) + numbers[at + i * j : at + i * j + j]
        at += i * j + j
        if k < len(hyper.shapes) - 1:
            x = torch.nn.functional.silu(x)
    return x[..., 0]


def _torch_terms(hyper: Hypernetwork, c: list, like: torch.Tensor) -> torch.Tensor:
    """Coefficients of `log_calibration`."""
    return _torch_layers(hyper.calibration_layers, c, like)


def _torch_layers(layers: Layers, c: list, like: torch.Tensor) -> torch.Tensor:
    import torch

    h = torch.stack([torch.as_tensor(v).to(like).reshape(()) for v in c])
    for k, (W, b) in enumerate(layers):
        h = h @ _torch(W, like) + _torch(b, like)
        if k < len(layers) - 1:
            h = torch.nn.functional.silu(h)
    return h


def _torch(array: np.ndarray, like: torch.Tensor) -> torch.Tensor:
    import torch

    return torch.from_numpy(np.asarray(array, np.float64)).to(like)


def _drjit_terms(hyper: Hypernetwork, c: list, like: Lanes) -> list:
    """Coefficients of `log_calibration`."""
    import drjit as dr

    kind = type(like)
    h = _drjit_layers(hyper.calibration_layers, c, kind).array
    index = dr.uint32_array_t(kind)
    return [dr.gather(kind, h, index(k)) for k in range(N_TERMS)]


def _drjit_layers(layers: Layers, c: list, kind: type) -> Lanes:
    import drjit as dr

    h = dr.tensor_t(kind)(dr.concat([kind(v) for v in c]), (1, len(c)))
    for k, (W, b) in enumerate(layers):
        h = h @ _drjit(W, kind) + _drjit(b[None], kind)
        if k < len(layers) - 1:
            h = h / (1 + dr.exp(-h))
    return h


def _drjit(array: np.ndarray, kind: type) -> Lanes:
    import drjit as dr

    return dr.tensor_t(kind)(np.ascontiguousarray(array, np.float32))


def _drjit_network(hyper: Hypernetwork, c: list, features: list) -> Lanes:
    import drjit as dr
    from drjit import nn

    kind = type(sum(features[1:], features[0]))
    tensor = dr.tensor_t(kind)
    h = _drjit_layers(hyper.medium_layers, c, kind)
    numbers, at, parts = (_drjit(hyper.base[None], kind) + h @ _drjit(hyper.basis, kind)).array, 0, []
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
