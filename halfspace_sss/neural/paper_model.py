"""The network of the paper: a plain 3 x 256 perceptron of position and directions, kept to compare with."""

from __future__ import annotations

from collections.abc import Sequence

from halfspace_sss.arrays import Library, Real
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.neural.material_model import load_network
from halfspace_sss.neural.network import RELU, Network, channel_queries
from halfspace_sss.neural.store import find_weights, load_weights, record_number
from halfspace_sss.physics.backbone import U_MAX, length_scale
from halfspace_sss.physics.fresnel import F_t, sine
from halfspace_sss.physics.medium import Medium

KIND, N_INPUTS = "neural_paper", 6
RADIUS = 4.0  # L; positions are divided by it
T_SMALLEST = 1e-6  # product of transmittances; the network holds S, which is 0 where they are


def paper_inputs(
    lib: Library, r: Real, line: Real, w_i: tuple[Real, Real], w_o: tuple[Real, Real], L: Real
) -> list[Real]:
    """Six numbers: (x, y) of x_o - x_i over 4 L and the horizontal parts of w_i and w_o.
    `r`: distance in mean free paths. `line`: azimuth of x_o - x_i in a fixed frame; the network is not invariant under
    rotation. `w_i`, `w_o`: sine and azimuth of the directions outside, in the same frame."""
    rho = r / (RADIUS * L)
    parts = [f(azimuth) * sine for sine, azimuth in (w_i, w_o) for f in (lib.cos, lib.sin)]
    return [rho * lib.cos(line), rho * lib.sin(line), *parts]


def query_inputs(q: Query, L: Real) -> list[Real]:
    """The six numbers of a query, in the frame in which w_i has azimuth 0, at most 12 L away."""
    lib = q.lib
    sines = [sine(mu) for mu in (q.mu_i, q.mu_o)]
    w_i, w_o = (sines[0], 0 * q.phi_i), (sines[1], q.phi_o - q.phi_i)
    return paper_inputs(lib, lib.minimum(q.r, U_MAX * L), -q.phi_i, w_i, w_o, L)


class NeuralPaper(BSSRDF):
    """The paper's setting: S ~ MLP(x, y, w_i, w_o), 3 hidden layers of 256 with ReLU, from the squared error of S.

    Neither reciprocal nor rotation-invariant nor positive: negative values are clamped (`measure.clamped_energy` tells
    how much), and it is asked in the frame in which w_i has azimuth 0. The weights come from
    `halfspace-sss train material --model neural_paper`, for as long as asked; they are not the authors' and not their
    converged result unless trained as long. Zero beyond 12 L, where it was not trained. Single scattering is left out.
    """

    name = KIND
    orders = "multiple"
    reciprocal = False
    mirror_invariant = False
    fast_in = "numpy"  # 1.6e5 evaluations per second and core, 5e4 in Dr.Jit
    source = "TG, Tran, Jensen, Ramamoorthi and Frisvad 2024, half-space network"

    def __init__(self, medium: Medium, trained: Sequence[tuple[Network, float]] | None = None) -> None:
        super().__init__(medium)
        self.trained: list[tuple[Network, float]] = list(trained or ())
        for m in () if trained else medium.channels():
            file = find_weights(KIND, m)
            scale = record_number(file, load_weights(file, KIND)[1], "scale", 0.0, 1e30)
            self.trained.append((load_network(file, KIND, m, N_INPUTS, RELU), scale))

    @property
    def checksums(self) -> tuple[str, ...]:
        return tuple(f"{network.checksum} {scale!r}" for network, scale in self.trained)

    def G(self, q: Query) -> Real:
        return q.lib.maximum(self.G_unclamped(q), 0.0)

    def G_unclamped(self, q: Query) -> Real:
        """G before negative values are set to zero."""
        m = self.medium
        queries = [q] if m.n_channels is None else channel_queries(q, m)
        values = [self._one(*parts) for parts in zip(queries, m.channels(), self.trained)]
        return values[0] if m.n_channels is None else q.lib.stack(values)

    def _one(self, query: Query, m: Medium, trained: tuple[Network, float]) -> Real:
        network, scale = trained
        q = query.in_float64()  # the raw output crosses zero, where float32 has no digits
        lib, L = q.lib, q.constant(length_scale(m.albedo, m.g))
        S = q.constant(scale) * network(query_inputs(q, L))
        G = S / lib.maximum(F_t(q.mu_i, q.index) * F_t(q.mu_o, q.index), T_SMALLEST)
        return lib.like(lib.where(q.r > U_MAX * L, 0 * G, G), query.r)
