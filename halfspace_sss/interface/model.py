"""The interface of all half-space models: their `Query`, `BSSRDF`, and `Separable` for those of the distance alone."""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from halfspace_sss.arrays import Library, Real, asks_nothing, broadcast_query, is_torch, labelled
from halfspace_sss.checks import QUERY, check_query
from halfspace_sss.physics.fresnel import C_phi, F_t, mu_internal, sine
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import torch

FARTHEST = 0.44  # of the exponent range: in mean free paths, where r² is finite and r⁻³ is 0 in every precision


@dataclass(frozen=True)
class Query:
    """A half-space query in mean free paths, with refracted cosines, in one array library.
    The refracted directions of travel, in a frame whose x axis points from x_i to x_o and z outwards, are w_12 =
    (-sin_i cos phi_i, -sin_i sin phi_i, -mu_i_in) and w_21 = (sin_o cos phi_o, sin_o sin phi_o, mu_o_in)."""

    lib: Library
    r: Real
    mu_i: Real
    phi_i: Real
    mu_o: Real
    phi_o: Real
    eta: float
    r_mm: Real | None = None
    sigma_t: Real | None = None  # r = sigma_t r_mm, kept so that `in_float64` does not inherit the rounding of r

    @functools.cached_property
    def index(self) -> Real:
        """eta as a constant; matched media, which are answered without Fresnel's equations, keep the number 1."""
        return self.constant(self.eta) if isinstance(self.eta, (int, float)) and self.eta != 1 else self.eta

    @functools.cached_property
    def mu_i_in(self) -> Real:
        return mu_internal(self.mu_i, self.index)

    @functools.cached_property
    def mu_o_in(self) -> Real:
        return mu_internal(self.mu_o, self.index)

    @functools.cached_property
    def sin_i(self) -> Real:
        """Sine of the refracted angle, sqrt(1 - mu_i²)/eta, at most 1."""
        return self._sine(self.mu_i)

    @functools.cached_property
    def sin_o(self) -> Real:
        return self._sine(self.mu_o)

    def _sine(self, mu: Real) -> Real:
        return self.lib.minimum(sine(mu) / self.index, 1.0)

    def constant(self, value: Real) -> Real:
        """A constant of the model (number, or one per channel) in the library and precision of the query."""
        return self.lib.constant(value, self.r)

    def in_float64(self) -> Query:
        """The same query in float64, for formulas whose terms cancel."""
        f = self.lib.float64
        r = f(self.r) if self.r_mm is None else f(self.r_mm)
        if self.r_mm is not None:
            r = self.lib.constant(self.sigma_t, r) * r
        return Query(self.lib, r, f(self.mu_i), f(self.phi_i), f(self.mu_o), f(self.phi_o), self.eta)


class PositionSample(NamedTuple):
    """Where light enters: distance r (mm) and azimuth phi of x_i about x_o from w_o, density pdf (1/mm²)."""

    r: Real
    phi: Real
    pdf: Real


class DirectionSample(NamedTuple):
    """Where light comes from: mu_i, phi_i as in `BSSRDF.eval`, density pdf over outside directions (1/sr)."""

    mu_i: Real
    phi_i: Real
    pdf: Real


class BSSRDF(abc.ABC):
    """S(x_i, w_i; x_o, w_o) of a half-space in 1/(mm² sr), made once from a medium, then only asked.

    A model gives `G`, the BSSRDF without its two Fresnel transmittances in mean free paths; this class adds
    what all share: S = sigma_t² T_12(mu_i) T_21(mu_o) G(sigma_t r, ...), checks, channels and sampling.

    Attributes:
        name: its name in the registry.
        orders: "multiple" (two or more scattering events) or "total" (single scattering included).
        reciprocal: whether S(x_i, w_i; x_o, w_o) = S(x_o, w_o; x_i, w_i) holds exactly.
        source: paper and equation.
        mirror_invariant: whether S(phi_i, phi_o) = S(-phi_i, -phi_o) holds exactly.
        fast_in: array library that evaluates it fastest on a CPU, "drjit" or "numpy".
        checksums: of the numbers that it was trained to, one for each network; a property where they are known late.
    """

    name: ClassVar[str]
    orders: ClassVar[str]
    reciprocal: ClassVar[bool]
    source: ClassVar[str]
    mirror_invariant: ClassVar[bool] = True
    fast_in: str = "drjit"
    checksums: tuple[str, ...] = ()

    def __new__(cls, *made_of: object, **options: object) -> BSSRDF:
        model = super().__new__(cls)
        options.pop("medium", None)
        model._options = (made_of[1:], options)
        return model

    def __init__(self, medium: Medium) -> None:
        if not isinstance(medium, Medium):
            raise ValueError(f"medium must be a Medium, got {type(medium).__name__}")
        self.medium = medium

    def __repr__(self) -> str:
        return f"<{self.name}, orders {self.orders}: {self.medium}>"

    @abc.abstractmethod
    def G(self, q: Query) -> Real:
        """S / (T_12 T_21) in 1/(mfp² sr) for a query in mean free paths."""

    def G_unclamped(self, q: Query) -> Real:
        """`G` before negative values are clamped; a model that clamps gives it."""
        return self.G(q)

    def eval(self, r: Real, mu_i: Real, phi_i: Real, mu_o: Real, phi_o: Real) -> Real:
        """S in 1/(mm² sr).

        Args:
            r: distance |x_o - x_i| in mm, >= 0.
            mu_i, mu_o: cosines of w_i and w_o with the outward normal, [0, 1].
            phi_i, phi_o: azimuths of w_i and w_o about the normal from the direction x_i -> x_o, radians.
                Arguments broadcast as in NumPy; a medium with channels adds its channel axis last.

        Series of pandas and arrays of xarray give the same again, with their labels; the latter broadcast by dimension.
        Derivatives by torch are recorded in blocks, so that their memory is bounded; the numbers are the same.
        Derivatives with respect to a medium of tensors are recorded at once.

        Raises:
            ValueError: an argument is out of range or not a number (NumPy and torch; Dr.Jit lanes cannot be
                inspected while a kernel is recorded), or libraries are mixed.
        """
        return self._S(self.G, r, mu_i, phi_i, mu_o, phi_o)

    def eval_unclamped(self, r: Real, mu_i: Real, phi_i: Real, mu_o: Real, phi_o: Real) -> Real:
        """`eval` without the clamp that keeps a model from turning negative; the same where it has none."""
        return self._S(self.G_unclamped, r, mu_i, phi_i, mu_o, phi_o)

    def _S(self, G_of: Callable[[Query], Real], *query: Real) -> Real:
        """sigma_t² T_12 T_21 G_of(query), with the labels of the query."""
        return labelled(functools.partial(self._S_of_arrays, G_of), query, "S", self.medium.n_channels is not None)

    def _S_of_arrays(self, G_of: Callable[[Query], Real], *query: Real) -> Real:
        lib, args = broadcast_query(*query, names=QUERY)
        if asks_nothing(lib, args):
            return type(args[0])()
        args = check_query(lib, args, query)
        S = recorded_in_blocks(lib, functools.partial(self._S_of_checked, lib, G_of), args)
        return S[()] if isinstance(S, np.ndarray) else S

    def _S_of_checked(self, lib: Library, G_of: Callable[[Query], Real], *args: Real) -> Real:
        if self.medium.n_channels is not None:
            lib.constant(self.medium.sigma_t, args[0])
            args = tuple(a[..., None] for a in args)
        r, mu_i, phi_i, mu_o, phi_o = args
        sigma_t = lib.constant(self.medium.sigma_t, r)
        r = lib.minimum(r, lib.largest(r) ** FARTHEST / sigma_t)
        q = Query(
            lib, sigma_t * r, mu_i, phi_i, mu_o, phi_o, self.medium.eta, r_mm=r, sigma_t=self.medium.sigma_t
        )  # fmt: skip
        G = lib.like(G_of(q), r)
        return sigma_t * sigma_t * F_t(mu_i, q.index) * F_t(mu_o, q.index) * G

    @functools.cached_property
    def _radial_samplers(self) -> list[RadialSampler]:
        return [RadialSampler(self.for_medium(m).eval) for m in self.medium.in_mfp().channels()]

    def for_medium(self, medium: Medium) -> BSSRDF:
        """The same model, made with the same options, of another medium."""
        positional, named = self._options
        return type(self)(medium, *positional, **named)

    def _per_channel(
        self, lib: Library, x: Real, answer: Callable[[RadialSampler, float, Real], Real], has_axis: bool = False
    ) -> Real:
        """`answer(sampler, sigma_t, x)` for each channel, stacked last; x may have the axis of channels already."""
        if self.medium.n_channels is None:
            return answer(self._radial_samplers[0], self.medium.sigma_t, x)
        lib.constant(self.medium.sigma_t, x)
        pairs = enumerate(zip(self._radial_samplers, self.medium.sigma_t))
        return lib.stack([answer(s, float(t), x[..., k] if has_axis else x) for k, (s, t) in pairs])

    def _pdf_of(self, lib: Library, r: Real, has_axis: bool = False) -> Real:
        """Density of `sample_position` at distances, 1/mm²."""
        return self._per_channel(lib, r, lambda sampler, t, r: t**2 * sampler.pdf(lib, t * r), has_axis)

    def sample_position(self, mu_o: Real, u: Real | Sequence[Real]) -> PositionSample:
        """Sample where light enters for an exit direction, from the model's own radial profile.

        Args:
            mu_o: cosine of w_o, [0, 1].
            u: pair (u_1, u_2) of arrays of uniform numbers in [0, 1) (a last axis of length 2 also works).

        Returns:
            r in mm, azimuth phi of x_i about x_o measured from w_o (so phi_o = pi - phi), and the density in
            1/mm². A medium with channels adds its channel axis last.
        """
        u_1, u_2 = _split(u)
        lib, (u_1, u_2, mu_o) = broadcast_query(u_1, u_2, mu_o)
        if asks_nothing(lib, (u_1, u_2, mu_o)):
            return PositionSample(*(type(u_1)() for _ in PositionSample._fields))
        r = self._per_channel(lib, u_1, lambda sampler, sigma_t, u: sampler.sample(lib, u) / sigma_t)
        phi = 2 * math.pi * u_2
        pdf = self._pdf_of(lib, r, has_axis=True)
        return PositionSample(r, phi[..., None] + 0 * r if self.medium.n_channels else phi, pdf)

    def pdf_position(self, r: Real, phi: Real, mu_o: Real) -> Real:
        """Density of `sample_position` in 1/mm² at distance r (mm) and azimuth phi; arguments broadcast."""
        lib, (r, phi, mu_o) = broadcast_query(r, phi, mu_o)
        if asks_nothing(lib, (r, phi, mu_o)):
            return type(r)()
        return self._pdf_of(lib, r)

    def sample_direction(self, r: Real, mu_o: Real, phi_o: Real, u: Real | Sequence[Real]) -> DirectionSample:
        """Sample where light comes from, given the position: by the cosine over the directions that refract.

        pdf = mu_i / pi, or mu_i / (pi eta²) within the cone 1 - mu_i² < eta² for eta < 1.

        Args:
            r, mu_o, phi_o: the rest of the query, as in `eval`.
            u: pair of arrays of uniform numbers in [0, 1).
        """
        u_1, u_2 = _split(u)
        lib, (u_1, u_2, r, mu_o, phi_o) = broadcast_query(u_1, u_2, r, mu_o, phi_o)
        if asks_nothing(lib, (u_1, u_2, r, mu_o, phi_o)):
            return DirectionSample(*(type(u_1)() for _ in DirectionSample._fields))
        cone = min(1.0, self.medium.eta**2)
        mu_i = lib.sqrt(lib.maximum(1 - cone * u_1, 0.0))
        phi_i = 2 * math.pi * u_2 - math.pi
        return DirectionSample(mu_i, phi_i, mu_i / (math.pi * cone))

    def pdf_direction(self, mu_i: Real, phi_i: Real, r: Real, mu_o: Real, phi_o: Real) -> Real:
        """Density of `sample_direction` over outside directions, 1/sr."""
        lib, (mu_i, phi_i, r, mu_o, phi_o) = broadcast_query(mu_i, phi_i, r, mu_o, phi_o)
        if asks_nothing(lib, (mu_i, phi_i, r, mu_o, phi_o)):
            return type(mu_i)()
        cone = min(1.0, self.medium.eta**2)
        inside = (1 - mu_i) * (1 + mu_i) <= cone
        return lib.where(inside, mu_i / (math.pi * cone), 0 * mu_i)


def _split(u: Real | Sequence[Real]) -> tuple[Real, Real]:
    if isinstance(u, (tuple, list)):
        if len(u) != 2:
            raise ValueError(f"u must be a pair of arrays, got {len(u)} of them")
        return u[0], u[1]
    if type(u).__module__.startswith(("drjit", "mitsuba")):
        return u[0], u[1]
    if u.shape[-1] != 2:
        raise ValueError(f"u must have a last axis of length 2, got shape {tuple(u.shape)}")
    return u[..., 0], u[..., 1]


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
    def R_d(self, q: Query) -> Real:
        """Radial exitance profile in 1/mfp², for q.r in mean free paths."""

    @property
    @abc.abstractmethod
    def N(self) -> float:
        """Exit normaliser: 1 as in Jensen et al. 2001, or `exit_normaliser(eta)`, which conserves the flux."""

    def G(self, q: Query) -> Real:
        return self.R_d(q) / q.constant(math.pi * self.N)


# ---- Distances between entry and exit, drawn by the radial profile of a model

R_MIN, R_MAX = 1e-5, 1e6  # mean free paths; the table starts and can at most end there
TAIL_MASS = 1e-4  # least probability of the power-law tail, so that no distance has density 0


class RadialSampler:
    """Piecewise density over r in mean free paths, exact to sample and to evaluate. Cells are uniform in log r below
    the radius where r² R(r) has died out; within a cell r is uniform, so the density over the plane is P_k / (2 pi r
    (r_{k+1} - r_k)). Beyond the last edge r_max the tail follows r_max / r², which covers the plane also where a
    profile falls as r⁻³ (no absorption). `S`: `BSSRDF.eval` of a model of a scalar medium with sigma_t = 1."""

    def __init__(self, S: Callable[..., Real], n_cells: int = 256) -> None:
        r = np.geomspace(R_MIN, R_MAX, 2 * n_cells)
        mass = r * r * _profile(S, r)
        top = max(float(mass.max()), 1e-300)
        beyond = np.nonzero(mass > 1e-7 * top)[0]
        r_max = r[min(beyond[-1] + 1, len(r) - 1)] if len(beyond) else 1.0
        self.edges: np.ndarray = np.concatenate([[0.0], np.geomspace(R_MIN, r_max, n_cells)])
        middle = np.concatenate([[0.5 * R_MIN], np.sqrt(self.edges[1:-1] * self.edges[2:])])
        weight = middle * _profile(S, middle) * np.diff(self.edges)
        if not weight.sum() > 0:
            weight = np.diff(np.log(np.maximum(self.edges, 0.5 * R_MIN)))
        probability = np.append((1 - TAIL_MASS) * weight / weight.sum(), TAIL_MASS)
        self.cdf: np.ndarray = np.concatenate([[0.0], np.cumsum(probability)])
        self.cdf[-1] = 1.0
        self.probability: np.ndarray = np.diff(self.cdf)
        self.width: np.ndarray = np.append(np.diff(self.edges), r_max)
        self.r_max = r_max

    def sample(self, lib: Library, u: Real) -> Real:
        """Distance r in mean free paths for uniform u in [0, 1)."""
        u64 = lib.float64(u)
        k = lib.interval(self.cdf[:-1], u64)
        fraction = (u64 - lib.take(self.cdf[:-1], k, u64)) / lib.maximum(lib.take(self.probability, k, u64), 1e-300)
        fraction = lib.minimum(lib.maximum(fraction, 0.0), 1 - 1e-12)
        inner = lib.take(self.edges, k, u64) + fraction * lib.take(self.width, k, u64)
        r = lib.where(k == len(self.edges) - 1, self.r_max / (1 - fraction), inner)
        return lib.like(r, u)

    def pdf(self, lib: Library, r: Real) -> Real:
        """Density over the plane, 1/mfp²."""
        r64 = lib.float64(r)
        k = lib.interval(self.edges, r64)
        density = lib.take(self.probability / self.width, k, r64)
        ratio = self.r_max / lib.maximum(r64, self.r_max)  # 1 inside the table
        return lib.like(density * ratio * ratio / (2 * math.pi * lib.maximum(r64, 1e-12)), r)


def _profile(S: Callable[..., Real], r: np.ndarray) -> np.ndarray:
    """∫ S mu_i dw_i over directions of incidence at steep exit, averaged over azimuths: what positions follow."""
    mu_i = np.array([0.95, 0.7, 0.4])
    phi = np.linspace(0, math.pi, 5)
    values = S(r[:, None, None], mu_i[:, None], phi, 0.9, 0.5 * math.pi)
    values = np.where(np.isfinite(values), values, 0.0)
    return (values * mu_i[:, None]).mean(axis=(1, 2))


# ---- Derivatives by torch in blocks of queries, so that their memory is bounded

BLOCK_BYTES = 1 << 27  # that torch keeps of one block
PROBE = 64  # queries


def recorded_in_blocks(lib: Library, f: Callable[..., Real], args: tuple[Real, ...]) -> Real:
    """f(*args), a function of each query alone, so that torch keeps the arguments for its derivatives and no more.
    torch keeps what every operation was given, tens of kB a query where a model integrates. Queries that would exceed
    `BLOCK_BYTES` are therefore split, and each block is recorded when it is gone through backwards. Other libraries,
    and what is not differentiated, are answered at once."""
    if not _recorded(lib, args):
        return f(*args)
    from torch.utils.checkpoint import checkpoint

    torch, shape = lib.torch, args[0].shape
    flat = [a.reshape(-1) for a in args]
    size = max(PROBE, int(BLOCK_BYTES / max(_kept_bytes(torch, f, flat), 1.0)))
    if len(flat[0]) <= size:
        return f(*args)
    blocks = zip(*(a.split(size) for a in flat))
    values = torch.cat([checkpoint(f, *b, use_reentrant=False, preserve_rng_state=False) for b in blocks])
    return values.reshape(*shape, *values.shape[1:])


def _recorded(lib: Library, args: tuple) -> bool:
    """Whether torch records derivatives for going backwards, and of more queries than the probes take."""
    if not is_torch(lib) or not lib.torch.is_grad_enabled() or args[0].numel() <= 2 * PROBE:
        return False
    forward = lib.torch.autograd.forward_ad.unpack_dual
    if lib.torch._C._are_functorch_transforms_active() or any(forward(a).tangent is not None for a in args):
        return False
    return any(a.requires_grad for a in args)


def _kept_bytes(torch: ModuleType, f: Callable[..., Real], flat: list) -> float:
    """What the graph of f keeps of one query: by how much that of two probes differs from that of one."""
    sizes = []
    for n in (PROBE, 2 * PROBE):
        kept: dict[int, int] = {}

        def keep(tensor: torch.Tensor, kept: dict = kept) -> torch.Tensor:
            storage = tensor.untyped_storage()
            kept[storage.data_ptr()] = storage.nbytes()
            return tensor

        probe = [a[:n].clone().detach().requires_grad_(a.requires_grad) for a in flat]
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            graph = f(*probe)
        sizes.append(sum(kept.values()))
        del graph
    return (sizes[1] - sizes[0]) / PROBE
