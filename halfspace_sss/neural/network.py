"""A multilayer perceptron and its inputs, evaluated in NumPy, torch or Dr.Jit from the same numbers.

Swapping the directions (with both reversed) and mirroring the plane at the line x_i -> x_o change no feature of a
query, so a network of them is reciprocal and mirror-invariant exactly, without training. The small learnt models share
S = T_12 T_21 B(r) exp(network) a(mu_i) a(mu_o).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from halfspace_sss.arrays import Lanes, Library, Real, is_torch, library
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.neural.perceptron import Perceptron, relu, silu
from halfspace_sss.physics.backbone import U_MAX, backbone_shape, length_scale, warp
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import torch

N_FEATURES, N_MEDIUM = 13, 9
R_SMALLEST = 0.01  # of min(L, mfp): below it the learnt factor stays as it is there
DEPTHS = (0.25, 1.0, 4.0)  # mean free paths along the refracted rays; L is the fourth
RIDGE, ROUNDING = 1e-3, 1e-5
SOFT = 1e-4  # share of the squared depth that keeps the logarithm of a distance finite
Ray = tuple[Real, Real, Real]


def travel(q: Query) -> tuple[Ray, Ray]:
    """Directions of travel inside, in and out, as (x, y, mu'): x along x_i -> x_o, mu' the cosine with the normal."""
    lib = q.lib
    incoming = (-q.sin_i * lib.cos(q.phi_i), -q.sin_i * lib.sin(q.phi_i), q.mu_i_in)
    return incoming, (q.sin_o * lib.cos(q.phi_o), q.sin_o * lib.sin(q.phi_o), q.mu_o_in)


def symmetric_features(lib: Library, r: Real, incoming: Ray, outgoing: Ray, L: Real) -> list[Real]:
    """The features of a query, each of order one.

    With (x, y, mu') of both rays: u/4 where u = log(exp(r/L) - 1); x_i + x_o; mu_i' + mu_o' - 1; (x_i - x_o)²;
    (mu_i' - mu_o')²; (x_i - x_o)(mu_i' - mu_o'); y_i y_o; and for depths s of 0.25, 1 and 4 mean free paths and L the
    logarithm of the distance between the points s along both refracted rays over sqrt(r² + s²).
    `r`: distance in mean free paths. `incoming`, `outgoing`: from `travel`. `L`: length scale of the medium in mean
    free paths."""
    (x_i, y_i, mu_i), (x_o, y_o, mu_o) = incoming, outgoing
    x, y, mu = x_i + x_o, y_i + y_o, mu_i - mu_o
    d = x_i - x_o
    near = lib.maximum(r, R_SMALLEST * library(L).minimum(L, 1.0))
    u = lib.minimum(warp(lib, near / L), U_MAX)
    side = y * y + mu * mu
    gaps = []
    for s in (*DEPTHS, L):
        along = r - s * x
        s2 = s * s
        gaps.append(0.5 * lib.log((along * along + s2 * (side + SOFT)) / (r * r + s2)))
    return [
        0.25 * u,
        x,
        mu_i + mu_o - 1,
        d * d,
        mu * mu,
        d * mu,
        y_i * y_o,
        *gaps,
        *_meeting(lib, r, incoming, outgoing),
    ]


def _meeting(lib: Library, r: Real, incoming: Ray, outgoing: Ray) -> tuple[Real, Real]:
    """How closely the refracted rays pass each other, and how far light travels until there.
    At depth z they are |r - z v| apart, v = d_i/mu_i' + d_o/mu_o' in the plane; the least is at z = r v_x / (v² +
    0.05). Returns log(|r - z v| / r) and p / (1 + p) of the path p = z (1/mu_i' + 1/mu_o')."""
    (x_i, y_i, mu_i), (x_o, y_o, mu_o) = incoming, outgoing
    a, b = 1 / lib.maximum(mu_i, 1e-3), 1 / lib.maximum(mu_o, 1e-3)
    v_x, v_y = a * x_i + b * x_o, a * y_i + b * y_o
    forward = lib.maximum(v_x - ROUNDING * (a + b), 0.0)  # grazing rays that cancel leave no noise of rounding
    z = forward / (v_x * v_x + v_y * v_y + 0.05)  # over r
    across, along = z * v_y, 1 - z * v_x
    path = r * z * (a + b)
    return 0.5 * lib.log(along * along + across * across + RIDGE), path / (1 + path)


def medium_features(lib: Library, albedo: Real, g: Real, eta: Real, L: Real) -> list[Real]:
    """The features of a medium, each of order one and smooth over albedo [0, 1], g [-0.5, 0.98], eta [1, 2]."""
    albedo_prime = albedo * (1 - g) / (1 - albedo * g)
    log, x = lib.log, eta - 1
    return [
        2 * albedo - 1, log(1 - albedo + 1e-4) / 3 + 1, g, log(1 - g) / 1.5 + 0.5, 2 * x - 1, log(L) / 2 - 0.5,
        2 * albedo_prime - 1, log(1 - albedo_prime + 1e-4) / 3 + 1, log(x * x + 1e-3) / 2 + 1,
    ]  # fmt: skip


NUMPY_BLOCK = 4096  # queries whose activations stay in the cache


def layer_shapes(n_in: int, width: int, depth: int) -> list[tuple[int, int]]:
    """Shapes (inputs, outputs) of the layers of a network with `depth` hidden layers and one output."""
    return [(n_in, width), *[(width, width)] * (depth - 1), (width, 1)]


class Activation(NamedTuple):
    """A function of each number in the three libraries; NumPy's changes its argument."""

    numpy: Callable[[np.ndarray], object]
    torch: Callable[[torch.Tensor], torch.Tensor]
    drjit: Callable[[Lanes], Lanes]


def _silu_numpy(h: np.ndarray) -> None:
    h /= 1 + np.exp(-np.maximum(h, -80.0))


def _silu_torch(h: torch.Tensor) -> torch.Tensor:
    import torch

    return torch.nn.functional.silu(h)


SILU = Activation(_silu_numpy, _silu_torch, silu)  # x / (1 + exp(-x))
RELU = Activation(lambda h: np.maximum(h, 0, out=h), lambda h: h.clamp_min(0), relu)


@dataclass(frozen=True, eq=False)
class Network:
    """h_{k+1} = a(h_k W_k + b_k), the last layer without a.
    `matrices`: W_k of shape (inputs, outputs), NumPy float32, or tensors with derivatives. `biases`: b_k of shape
    (outputs,). `activation`: a, SILU or RELU."""

    matrices: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activation: Activation = SILU

    @classmethod
    def from_vector(cls, vector: Real, shapes: Sequence[tuple[int, int]], activation: Activation = SILU) -> Network:
        """The network whose numbers stand in `vector` layer after layer, each matrix before its bias."""
        matrices, biases, at = [], [], 0
        if not is_torch(library(vector)):
            vector = np.asarray(vector, np.float32)
        for n_in, n_out in shapes:
            matrices.append(vector[at : at + n_in * n_out].reshape(n_in, n_out))
            at += n_in * n_out
            biases.append(vector[at : at + n_out])
            at += n_out
        return cls(tuple(matrices), tuple(biases), activation)

    @property
    def checksum(self) -> str:
        """SHA-256 of all numbers."""
        digest = hashlib.sha256(repr([W.shape for W in self.matrices]).encode())
        for array in (*self.matrices, *self.biases):
            digest.update(np.ascontiguousarray(array, np.float32).tobytes())
        return digest.hexdigest()

    def __call__(self, features: Sequence[Real]) -> Real:
        """The output for features that are arrays of one shape, in their library and precision."""
        kind = type(features[0]).__module__.split(".")[0]
        evaluate = {"torch": self._torch, "drjit": self._drjit, "mitsuba": self._drjit}.get(kind, self._numpy)
        return evaluate(features)

    def _numpy(self, features: Sequence[np.ndarray]) -> np.ndarray:
        shape = np.broadcast_shapes(*(np.shape(f) for f in features))
        dtype = np.result_type(*features)
        columns = np.stack([np.broadcast_to(f, shape).ravel() for f in features], axis=-1).astype(dtype, copy=False)
        layers = [(W.astype(dtype), b.astype(dtype)) for W, b in zip(self.matrices, self.biases)]
        out = np.empty(len(columns), dtype)
        for at in range(0, len(columns), NUMPY_BLOCK):
            h = columns[at : at + NUMPY_BLOCK]
            for W, b in layers[:-1]:
                h = h @ W
                h += b
                self.activation.numpy(h)
            W, b = layers[-1]
            out[at : at + NUMPY_BLOCK] = (h @ W)[:, 0] + b[0]
        return out.reshape(shape)

    @functools.cached_property
    def _tensors(self) -> dict:
        return {}

    def _torch(self, features: Sequence[torch.Tensor]) -> torch.Tensor:
        import torch

        x = torch.stack(torch.broadcast_tensors(*features), dim=-1)
        tensors, key = self._tensors, (x.dtype, x.device)
        if key not in tensors:
            pairs = zip(self.matrices, self.biases)
            tensors[key] = [(torch.as_tensor(W).T.contiguous().to(x), torch.as_tensor(b).to(x)) for W, b in pairs]
        *hidden, (W, b) = tensors[key]
        for V, c in hidden:
            x = self.activation.torch(torch.nn.functional.linear(x, V, c))
        return torch.nn.functional.linear(x, W, b)[..., 0]

    @functools.cached_property
    def perceptron(self) -> Perceptron:
        """For Dr.Jit, with all outputs."""
        return Perceptron([W.T for W in self.matrices], self.biases, self.activation.drjit)

    def _drjit(self, features: Sequence[Lanes]) -> Lanes:
        return self.perceptron(features)[0]


LOG_RANGE = 30.0  # bound of the logarithm of the learnt factor


N_POLYNOMIALS = 4
GRAZING = (0.05, 0.25)  # inside cosines at which the other terms fall to a half
N_TERMS = N_POLYNOMIALS + len(GRAZING)


def log_calibration(c: Sequence[Real], mu: Real, mu_in: Real) -> Real:
    """log a = sum_k c_k T_k(2 mu - 1) + sum_j d_j s_j / (s_j + mu'); 0 for no terms. The polynomials, by Clenshaw's
    recurrence, are of the outside cosine. The others, s_j of `GRAZING`, are of that inside, mu': where the boundary is
    nearly matched the network is off for light that runs along it inside. `c`: coefficients c_k and d_j of a medium,
    numbers or arrays of the library of mu. `mu`, `mu_in`: cosines outside and inside, [0, 1]."""
    if not len(c):
        return 0.0 * mu
    twice, after, last = 4 * mu - 2, 0.0, 0.0 * mu
    for c_k in reversed(list(c)[1:N_POLYNOMIALS]):
        last, after = c_k + twice * last - after, last
    grazing = sum(d * (s / (s + mu_in)) for d, s in zip(list(c)[N_POLYNOMIALS:], GRAZING))
    return c[0] + 0.5 * twice * last - after + grazing


def log_calibrations(c: Sequence[Real], q: Query) -> Real:
    """log a(mu_i) a(mu_o) of a query, see `log_calibration`."""
    return log_calibration(c, q.mu_i, q.mu_i_in) + log_calibration(c, q.mu_o, q.mu_o_in)


def factored_G(network: Network, q: Query, albedo: Real, g: Real, eta: Real, calibration: Sequence[float] = ()) -> Real:
    """G = B(r) exp(network(features)) a(mu_i) a(mu_o) of one channel: positive, reciprocal and mirror-invariant.
    `calibration` are the coefficients of log a, see `log_calibration`; without them a is 1."""
    lib, L = q.lib, q.constant(length_scale(albedo, g))
    log_factor = network(symmetric_features(lib, q.r, *travel(q), L))
    if len(calibration):
        c = [q.constant(v) for v in calibration]
        log_factor = log_factor + log_calibrations(c, q)
    factor = lib.exp(lib.minimum(lib.maximum(log_factor, -LOG_RANGE), LOG_RANGE))
    return q.constant(albedo * albedo) * (backbone_shape(q.r, albedo, g, eta) * factor)


class SymmetricModel(BSSRDF):
    """A learnt BSSRDF of order >= 2 that is positive, reciprocal and mirror-invariant by construction.
    A model gives `networks`, the small network of each channel of its medium, and may give their `calibrations`."""

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
        parts = zip(self.networks, calibrations, m.channels(), channel_queries(q, m))
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
