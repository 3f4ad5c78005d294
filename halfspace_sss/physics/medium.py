"""Homogeneous medium below the plane: coefficients in 1/mm and what derives from them."""

from __future__ import annotations

import numbers
from dataclasses import dataclass
from typing import Any

import numpy as np

from halfspace_sss.physics.reflectance import DIFFUSE, albedo_of_reflectance, half_space_reflectance

__all__ = ["Medium", "check_ratios", "check_scalar_medium", "medium_of"]


def _check(name: str, value: np.ndarray, ok: np.ndarray, bound: str) -> None:
    if not np.all(ok):
        bad = np.atleast_1d(value)[~np.atleast_1d(ok)][0]
        raise ValueError(f"{name} must be {bound}, got {bad.item()!r}")


def _number(name: str, value: object) -> np.ndarray:
    try:
        if value is None or isinstance(value, (str, bytes)):  # NumPy would make NaN of one, read the other
            raise TypeError
        array = np.array(value, dtype=np.float64) + 0.0  # no -0.0, whose hash is not that of 0.0
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number or a sequence of numbers, got {value!r}") from error
    if array.ndim > 1:
        raise ValueError(f"{name} must be a scalar or one value per channel, got shape {array.shape}")
    return np.asarray(array)


def _common_shape(**fields: np.ndarray) -> tuple[int, ...]:
    """Shape of coefficients together: () or (channels,)."""
    try:
        return np.broadcast_shapes(*(value.shape for value in fields.values()))
    except ValueError as error:
        *first, last = fields
        names, shapes = f"{', '.join(first)} and {last}", ", ".join(str(value.shape) for value in fields.values())
        raise ValueError(f"{names} must have the same number of channels, got {shapes}") from error


def check_ratios(albedo: np.ndarray, g: np.ndarray, eta: np.ndarray) -> None:
    """Check arrays of what a half-space in mean free paths is made of, by the ranges of `Medium`.

    Raises:
        ValueError: an albedo is outside [0, 1], a g outside (-1, 1), an eta not finite or not > 0.
    """
    _check("albedo", albedo, (albedo >= 0) & (albedo <= 1), "in [0, 1]")
    _check("g", g, np.abs(g) < 1, "in the open interval (-1, 1)")
    _check("eta", eta, np.isfinite(eta) & (eta > 0), "finite and > 0")


@dataclass(frozen=True, eq=False)
class Medium:
    """A homogeneous participating medium with a smooth boundary.

    Args:
        sigma_s: scattering coefficient, 1/mm, scalar or one value per channel, >= 0.
        sigma_a: absorption coefficient, 1/mm, scalar or one value per channel, >= 0.
        g: mean cosine of the Henyey-Greenstein phase function, in (-1, 1), scalar or per channel.
        eta: relative index n_inside / n_outside, one number > 0.

    Everything else (`sigma_t`, `albedo`, `sigma_s_prime`, ...) derives from these four. Scalars stay
    scalars; if any coefficient has one value per channel, all have.

    Raises:
        ValueError: a coefficient is outside its range, not finite, has mismatched channels, or
            sigma_s + sigma_a = 0 (a mean free path would be infinite).
    """

    sigma_s: np.ndarray | float
    sigma_a: np.ndarray | float
    g: np.ndarray | float = 0.0
    eta: float = 1.3

    def __post_init__(self) -> None:
        fields = {name: _number(name, getattr(self, name)) for name in ("sigma_s", "sigma_a", "g")}
        eta = _number("eta", self.eta)
        if eta.ndim:
            raise ValueError(f"eta must be one number for all channels, got shape {eta.shape}")
        _check("eta", eta, np.isfinite(eta) & (eta > 0), "finite and > 0")
        for name in ("sigma_s", "sigma_a"):
            value = fields[name]
            _check(name, value, np.isfinite(value) & (value >= 0), "finite and >= 0 (1/mm)")
        _check("g", fields["g"], np.abs(fields["g"]) < 1, "in the open interval (-1, 1)")
        shape = _common_shape(**fields)
        if shape == (0,):
            raise ValueError("sigma_s must have at least one channel, got none")
        for name, value in fields.items():
            value = np.broadcast_to(value, shape)
            object.__setattr__(self, name, value.copy() if shape else float(value))
            if shape:
                getattr(self, name).setflags(write=False)
        object.__setattr__(self, "eta", float(eta))
        sigma_t = np.asarray(self.sigma_t)
        with np.errstate(divide="ignore", over="ignore"):
            ok = np.isfinite(sigma_t) & (sigma_t > 0) & np.isfinite(1 / sigma_t)
        _check("sigma_t = sigma_s + sigma_a", sigma_t, ok, "finite and > 0 (1/mm), and 1 / sigma_t finite")

    @classmethod
    def from_albedo(cls, albedo, sigma_t, g=0.0, eta=1.3) -> Medium:
        """The medium with single-scattering albedo in [0, 1] and extinction sigma_t (1/mm).

        sigma_s = albedo sigma_t, sigma_a = (1 - albedo) sigma_t.
        """
        albedo, sigma_t = _number("albedo", albedo), _number("sigma_t", sigma_t)
        _check("albedo", albedo, (albedo >= 0) & (albedo <= 1), "in [0, 1]")
        _check("sigma_t", sigma_t, np.isfinite(sigma_t) & (sigma_t > 0), "finite and > 0 (1/mm)")
        _common_shape(albedo=albedo, sigma_t=sigma_t)
        return cls(albedo * sigma_t, (1 - albedo) * sigma_t, g, eta)

    @classmethod
    def from_reduced(cls, sigma_s_prime, sigma_a, g=0.0, eta=1.3) -> Medium:
        """The medium whose reduced scattering is sigma_s_prime (1/mm): sigma_s = sigma_s_prime / (1 - g)."""
        sigma_s_prime, g = _number("sigma_s_prime", sigma_s_prime), _number("g", g)
        _check(
            "sigma_s_prime", sigma_s_prime, np.isfinite(sigma_s_prime) & (sigma_s_prime >= 0), "finite and >= 0 (1/mm)"
        )
        _check("g", g, np.abs(g) < 1, "in the open interval (-1, 1)")
        _common_shape(sigma_s_prime=sigma_s_prime, g=g)
        return cls(sigma_s_prime / (1 - g), sigma_a, g, eta)

    @classmethod
    def from_reflectance(cls, reflectance, mfp, g=0.0, eta=1.3, mu_i=DIFFUSE) -> Medium:
        """The medium whose half-space has a wanted reflectance, with the mean free path mfp = 1 / sigma_t (mm).

        What artists give: colour, radius and anisotropy (`subsurface_color`, `subsurface_radius` and
        `subsurface_scatter_anisotropy` of OpenPBR). `reflectance` is the fraction of incident flux that comes back out
        of the medium, without what the boundary mirrors, under uniform radiance from above ("diffuse") or at the cosine
        of incidence mu_i. Exact by discrete ordinates, to 1e-4 of itself; `Medium.reflectance` is the
        inverse. For a texture take `physics.reflectance.albedo_of_reflectance`.

        Raises:
            ValueError: a colour is out of reach at this eta, or another argument is out of range.
        """
        reflectance, mfp, g = (_number(n, v) for n, v in (("reflectance", reflectance), ("mfp", mfp), ("g", g)))
        _check("mfp", mfp, np.isfinite(mfp) & (mfp > 0), "finite and > 0 (mm)")
        _check("g", g, np.abs(g) < 1, "in the open interval (-1, 1)")
        shape = _common_shape(reflectance=reflectance, mfp=mfp, g=g)
        eta = _number("eta", eta)
        if eta.ndim:
            raise ValueError(f"eta must be one number for all channels, got shape {eta.shape}")
        _check("eta", eta, np.isfinite(eta) & (eta > 0), "finite and > 0")
        pairs = np.broadcast(reflectance, np.broadcast_to(g, shape))
        albedo = np.array([float(albedo_of_reflectance(R, float(k), float(eta), mu_i)) for R, k in pairs])
        return cls.from_albedo(albedo.reshape(pairs.shape), 1 / mfp, g, eta)

    def reflectance(self, mu_i: float | str = DIFFUSE):
        """The fraction of incident flux that comes back out of the half-space, per channel, all orders.

        mu_i is the cosine of incidence, or "diffuse" for uniform radiance from above. Exact by discrete
        ordinates; left out is what the boundary mirrors.
        """
        pairs = np.broadcast(self.albedo, self.g)
        found = np.array([half_space_reflectance(float(a), float(g), self.eta, mu_i) for a, g in pairs])
        return found if self.n_channels is not None else float(found[0])

    @property
    def n_channels(self) -> int | None:
        """Number of channels, None for a scalar medium."""
        return len(self.sigma_s) if np.ndim(self.sigma_s) else None

    @property
    def sigma_t(self):
        """Extinction coefficient sigma_s + sigma_a, 1/mm."""
        return self.sigma_s + self.sigma_a

    @property
    def mfp(self):
        """Mean free path 1 / sigma_t, mm."""
        return 1 / self.sigma_t

    @property
    def albedo(self):
        """Single-scattering albedo sigma_s / sigma_t."""
        return self.sigma_s / self.sigma_t

    @property
    def sigma_s_prime(self):
        """Reduced scattering coefficient (1 - g) sigma_s, 1/mm."""
        return (1 - self.g) * self.sigma_s

    @property
    def sigma_t_prime(self):
        """Reduced extinction coefficient sigma_s_prime + sigma_a, 1/mm."""
        return self.sigma_s_prime + self.sigma_a

    @property
    def albedo_prime(self):
        """Reduced albedo sigma_s_prime / sigma_t_prime."""
        return self.sigma_s_prime / self.sigma_t_prime

    def scaled(self, factor: float) -> Medium:
        """The same medium with both coefficients multiplied by `factor` > 0 (a dilution, or a change of unit)."""
        number = _number("factor", factor)
        if number.ndim:
            raise ValueError(f"factor must be one number, got shape {number.shape}")
        _check("factor", number, np.isfinite(number) & (number > 0), "finite and > 0")
        factor = float(number)
        return Medium(factor * self.sigma_s, factor * self.sigma_a, self.g, self.eta)

    def in_mfp(self) -> Medium:
        """The medium with lengths measured in its own mean free path (per channel): sigma_t = 1."""
        return Medium(self.sigma_s / self.sigma_t, self.sigma_a / self.sigma_t, self.g, self.eta)

    def channel(self, index: int) -> Medium:
        """The scalar medium of one channel; a scalar medium has only channel 0."""
        n = self.n_channels or 1
        if not isinstance(index, numbers.Integral) or not 0 <= index < n:
            raise ValueError(f"channel must be a whole number in [0, {n - 1}], got {index!r}")
        s, a, g = (np.atleast_1d(v)[index] for v in (self.sigma_s, self.sigma_a, self.g))
        return Medium(float(s), float(a), float(g), self.eta)

    def __str__(self) -> str:
        """sigma_t (1/mm), albedo, g and eta; one number for each channel where they differ."""
        parts = (
            ("sigma_t", self.sigma_t, "/mm"),
            ("albedo", self.albedo, ""),
            ("g", self.g, ""),
            ("eta", self.eta, ""),
        )
        return ", ".join(f"{name} {_short(value)}{unit}" for name, value, unit in parts)

    def _repr_html_(self) -> str:
        names = ("sigma_s", "sigma_a", "sigma_t", "albedo", "g", "mfp")
        units = {"sigma_s": "1/mm", "sigma_a": "1/mm", "sigma_t": "1/mm", "mfp": "mm"}
        head = "".join(f"<th>{name} {units.get(name, '')}</th>" for name in names)
        rows = "".join(
            "<tr>" + "".join(f"<td>{_short(getattr(m, name))}</td>" for name in names) + "</tr>"
            for m in ([self] if self.n_channels is None else [self.channel(k) for k in range(self.n_channels)])
        )
        return f"<table><caption>medium, eta {self.eta:.4g}</caption><tr>{head}</tr>{rows}</table>"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Medium):
            return NotImplemented
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("sigma_s", "sigma_a", "g", "eta"))

    def __hash__(self) -> int:
        return hash(tuple(np.asarray(getattr(self, n)).tobytes() for n in ("sigma_s", "sigma_a", "g", "eta")))


def _short(value: Any) -> str:
    """To four digits; one number where all are the same."""
    found = [f"{x:.4g}" for x in np.atleast_1d(value).tolist()]
    return found[0] if len(set(found)) == 1 else " ".join(found)


def check_scalar_medium(medium: Any) -> None:
    if not isinstance(medium, Medium):
        raise ValueError(f"medium must be a Medium, got {type(medium).__name__}")
    if medium.n_channels is not None:
        raise ValueError(f"medium must have one channel (take medium.channel(k)), got {medium.n_channels} channels")


def medium_of(found: Any) -> Any:
    """The medium of a material; anything else as it is."""
    return getattr(found, "medium", found)
