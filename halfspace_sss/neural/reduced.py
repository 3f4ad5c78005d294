"""`neural` for media whose albedo differs from query to query: two of its networks stand for those of all albedos.

The logarithm of the learnt factor, network and calibration, of albedos between two is close to few functions of a
query,

    ln factor(x; albedo) = phi_0(x) + Σ_k c_k(albedo) phi_k(x),    k = 1 ... 4,

linear in the last hidden layers of the networks of two albedos. They are found by least squares over random queries, as
those of each of many albedos first, whose largest singular vectors are kept.

Measured over other random queries, weighted by r² sqrt(S_o S_i) of pairs of albedos, eta 1.4, in %:

    g, albedos          mean of the magnitude    worst pair    its sum, worst pair
    0, 0.5 to 0.999              0.5                 0.9              0.2
    0, 0.0001 to 1               0.9                 1.9              0.4
    0.5, 0.3 to 0.999            0.8                 1.5              0.2
    0.8, 0.6 to 0.9999           1.4                 4.0              0.9

With one network, of the middle, the mean is 1.3, 1.8 and, for g = 0.8, 5.9 %.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halfspace_sss.arrays import Lanes, Real, library
from halfspace_sss.interface.model import Query
from halfspace_sss.neural.network import (
    LOG_RANGE,
    Network,
    SymmetricModel,
    log_calibrations,
    symmetric_features,
    travel,
)
from halfspace_sss.physics.backbone import backbone_shape, length_scale
from halfspace_sss.physics.medium import check_numbers

PLACES = 0.1, 0.9  # of the two networks among the models
MODES = 4  # functions beside the first
QUERIES, SEED = 4096, 11
NEAREST, FURTHEST = 0.005, 8.0  # mean free paths, and length scales: distances of queries
RIDGE = 1e-6


class ReducedNetworks:
    """Functions phi of a query, and their coefficients for the albedo of each model.

    Attributes:
        networks: with phi_0 ... phi_4 for outputs, which are added up.
        lengths: L of the features of each.
        coefficients: c of the models, shape (models, MODES).

    Raises:
        ValueError: a medium has derivatives, which would be lost.
    """

    def __init__(self, models: Sequence[SymmetricModel]) -> None:
        """Reduce models of one g and eta, in an order of albedos in which they are smooth."""
        for m in models:
            check_numbers("medium", m.medium)
        q = _queries(max(_length(m) for m in models), models[0].medium.eta)
        learnt = (m.networks[0](_features(q, _length(m))) + log_calibrations(m.calibrations[0], q) for m in models)
        wanted = np.stack(list(learnt))
        weights = _weights(models, q, wanted)
        kept = [models[round(place * (len(models) - 1))] for place in PLACES]
        columns = [_hidden(m.networks[0], np.stack(_features(q, _length(m)), axis=1)) for m in kept]
        A = np.concatenate([*columns, np.ones((QUERIES, 1))], axis=1)
        rows = np.stack([_least_squares(A, y, w) for y, w in zip(wanted, weights)])
        modes, self.coefficients = _modes(rows, (A * weights.sum(axis=0)[:, None]).T @ A)
        self.networks, self.lengths, at = [], [_length(m) for m in kept], 0
        for k, m in enumerate(kept):
            net, width = m.networks[0], columns[k].shape[1]
            last = np.ascontiguousarray(modes[:, at : at + width].T, np.float32)
            bias = (modes[:, -1] * (k == 0)).astype(np.float32)
            self.networks.append(Network((*net.matrices[:-1], last), (*net.biases[:-1], bias), net.activation))
            at += width

    def functions(self, q: Query) -> list[Lanes]:
        """phi_0 ... phi_4 of a query in Dr.Jit."""
        values = [net.perceptron(_features(q, L)) for net, L in zip(self.networks, self.lengths)]
        return [sum(parts) for parts in zip(*values)]


def shape_over_power(q: Query, albedo: Real, g: Real, log_factor: Real) -> Real:
    """S / albedo² without Fresnel transmittances, for sigma_t = 1, of numbers or arrays of a library."""
    lib = q.lib
    factor = lib.exp(lib.minimum(lib.maximum(log_factor, -LOG_RANGE), LOG_RANGE))
    return backbone_shape(q.r, albedo, g, q.index) * factor


def _length(model: SymmetricModel) -> float:
    return float(length_scale(float(model.medium.albedo), float(model.medium.g)))


def _features(q: Query, L: float) -> list[Real]:
    return symmetric_features(q.lib, q.r, *travel(q), q.constant(L))


def _queries(longest: float, eta: float) -> Query:
    """Random queries, the directions by the cosine, the logarithm of the distance even."""
    u = np.random.default_rng(SEED).uniform(size=(5, QUERIES))
    r = NEAREST * (FURTHEST * longest / NEAREST) ** u[0]
    mu_i, mu_o = np.sqrt(u[1:3])
    phi_i, phi_o = 2 * np.pi * u[3:] - np.pi
    return Query(library(r), r, mu_i, phi_i, mu_o, phi_o, eta)


def _weights(models: Sequence[SymmetricModel], q: Query, log_factors: np.ndarray) -> np.ndarray:
    """r² sqrt(S_o S_i) of each model at one end, with every model at the other, shape (models, queries)."""
    S = [shape_over_power(q, float(m.medium.albedo), float(m.medium.g), y) for m, y in zip(models, log_factors)]
    roots = q.r * np.sqrt(np.maximum(S, 1e-30))
    return roots * ((1 / (roots @ roots.T)) @ roots)


def _hidden(network: Network, x: np.ndarray) -> np.ndarray:
    for W, b in zip(network.matrices[:-1], network.biases[:-1]):
        x = x @ W.astype(float) + b
        network.activation.numpy(x)
    return x


def _least_squares(A: np.ndarray, y: np.ndarray, w: np.ndarray) -> np.ndarray:
    normal = (A * w[:, None]).T @ A
    normal += RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.linalg.solve(normal, A.T @ (w * y))


def _modes(rows: np.ndarray, metric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of rows and their largest singular vectors in a metric, (1 + MODES, columns), and coefficients."""
    root = np.linalg.cholesky(metric + 1e-9 * np.trace(metric) * np.eye(len(metric)))
    mean = rows.mean(axis=0)
    U, s, V = np.linalg.svd((rows - mean) @ root, full_matrices=False)
    modes = np.linalg.solve(root.T, V[:MODES].T).T
    size = np.sqrt(s[:MODES])[:, None]  # of both factors alike
    return np.concatenate([mean[None], modes * size]), U[:, :MODES] * size.T
