"""Homogeneous medium below the plane: coefficients in 1/mm and what derives from them, and its phase function.

The phase function is that of Henyey and Greenstein, normalised to one over the sphere. `Layers` of media are parallel
to the plane.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from halfspace_sss.arrays import PerChannel, Real, is_torch, library
from halfspace_sss.physics.reflectance import DIFFUSE, albedo_of_reflectance, half_space_reflectance

INDICES = (0.01, 100.0)  # relative: beyond, Fresnel's moments lose their digits
EXTINCTIONS = (1e-18, 1e18)  # 1/mm: of float32 sigma_t² and its inverse are in range
DIFFUSE_LIMIT = 1e-3  # of the largest mean free path of all channels
CLEAR = "a clear layer is sigma_s = 1e-9, g = 0"


def _check(name: str, value: Real, ok: Real, bound: str, hint: str = "") -> None:
    if not ok.all():
        bad = value.reshape(-1)[~ok.reshape(-1)][0]
        raise ValueError(f"{name} must be {bound}, got {bad.item()!r}{hint}")


def _number(name: str, value: object) -> np.ndarray:
    try:
        if value is None or isinstance(value, (str, bytes)):  # NumPy would make NaN of one, read the other
            raise TypeError
        array = np.asarray(value, dtype=np.float64) + 0.0  # no -0.0, whose hash is not that of 0.0
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # RuntimeError: torch, for requires_grad
        raise ValueError(f"{name} must be a number or a sequence of numbers, got {value!r}") from error
    return _scalar_or_channels(name, np.asarray(array))


def _scalar_or_channels(name: str, array: Real) -> Real:
    if array.ndim > 1:
        raise ValueError(f"{name} must be a scalar or one value per channel, got shape {tuple(array.shape)}")
    return array


def _coefficients(**given: object) -> dict[str, Real]:
    """Each as an array of float64; all as tensors where torch records derivatives by one."""
    traced = [value for value in given.values() if getattr(value, "requires_grad", False)]
    numbers = {name: v if traced and is_torch(library(v)) else _number(name, v) for name, v in given.items()}
    if not traced:
        return numbers
    lib, like = library(traced[0]), traced[0].double()
    return {name: _scalar_or_channels(name, lib.like(value, like)) for name, value in numbers.items()}


def _index(name: str, value: object) -> float:
    index = _number(name, value)
    if index.ndim:
        raise ValueError(f"{name} must be one number for all channels, got shape {index.shape}")
    _check(name, index, *_between(index, INDICES))
    return float(index)


def _between(value: Real, bounds: tuple[float, float]) -> tuple[Real, str]:
    """Where a value is within bounds, and the bounds in words."""
    return (value >= bounds[0]) & (value <= bounds[1]), f"in [{bounds[0]:g}, {bounds[1]:g}]"


def _common_shape(**fields: Real) -> tuple[int, ...]:
    """Shape of coefficients together: () or (channels,)."""
    try:
        return np.broadcast_shapes(*(tuple(value.shape) for value in fields.values()))
    except ValueError as error:
        *first, last = fields
        shapes = ", ".join(str(tuple(value.shape)) for value in fields.values())
        names = f"{', '.join(first)} and {last}"
        raise ValueError(f"{names} must have the same number of channels, got {shapes}") from error


def check_ratios(albedo: np.ndarray, g: np.ndarray, eta: np.ndarray) -> None:
    """Check arrays of what a half-space in mean free paths is made of, by the ranges of `Medium`.
    ValueError if an albedo is outside [0, 1], a g outside (-1, 1), an eta outside [0.01, 100]."""
    _check("albedo", albedo, (albedo >= 0) & (albedo <= 1), "in [0, 1]")
    _check("g", g, np.abs(g) < 1, "in the open interval (-1, 1)")
    _check("eta", eta, *_between(eta, INDICES))


def diffuse_limit(mfp: np.ndarray) -> np.ndarray:
    """Mean free paths of channels with 1e-3 of the largest in place of 0: light then leaves where it has entered.
    Reflectance does not depend on it. Where all are 0 they stay so."""
    mfp = np.asarray(mfp, dtype=float)
    return np.where(mfp == 0, DIFFUSE_LIMIT * np.max(mfp, initial=0.0), mfp)


@dataclass(frozen=True, eq=False)
class Medium:
    """A homogeneous participating medium with a smooth boundary.

    Args:
        sigma_s: scattering coefficient, 1/mm, scalar or one value per channel, >= 0.
        sigma_a: absorption coefficient, 1/mm, scalar or one value per channel, >= 0.
        g: mean cosine of the Henyey-Greenstein phase function, in (-1, 1), scalar or per channel.
        eta: relative index n_inside / n_outside, one number in [0.01, 100].

    Everything else (`sigma_t`, `albedo`, `sigma_s_prime`, ...) derives from these four. Scalars stay
    scalars; if any coefficient has one value per channel, all have. sigma_s, sigma_a and g may be torch tensors that
    require gradients: all three are then tensors of float64, and S of a torch query has gradients with respect to
    them (make medium and model anew for each step of an optimiser). `detached` gives the numbers. Such a medium equals
    no other.

    Raises:
        ValueError: a coefficient is outside its range, not finite, has mismatched channels, or
            sigma_s + sigma_a is outside [1e-18, 1e18], as 0 is (a mean free path would be infinite).
    """

    # or tensors: Dr.Jit resolves the hints of what a scene holds, and torch is not imported there
    sigma_s: np.ndarray | float
    sigma_a: np.ndarray | float
    g: np.ndarray | float = 0.0
    eta: float = 1.3

    def __post_init__(self) -> None:
        fields = _coefficients(sigma_s=self.sigma_s, sigma_a=self.sigma_a, g=self.g)
        lib, eta = library(*fields.values()), _index("eta", self.eta)
        for name in ("sigma_s", "sigma_a"):
            value = fields[name]
            _check(name, value, lib.isfinite(value) & (value >= 0), "finite and >= 0 (1/mm)")
        hint = f"; with g = 1 nothing is scattered: {CLEAR}" if (fields["g"] == 1).any() else ""
        _check("g", fields["g"], lib.abs(fields["g"]) < 1, "in the open interval (-1, 1)", hint)
        shape = _common_shape(**fields)
        if shape == (0,):
            raise ValueError("sigma_s must have at least one channel, got none")
        for name, value in fields.items():
            if is_torch(lib):
                _check(name, value, (value > 0) | (name != "sigma_a"), "> 0 for gradients: roots of it have none at 0")
                object.__setattr__(self, name, value.broadcast_to(shape))
                continue
            value = np.broadcast_to(value, shape)
            object.__setattr__(self, name, value.copy() if shape else float(value))
            if shape:
                getattr(self, name).setflags(write=False)
        object.__setattr__(self, "eta", eta)
        sigma_t = self.sigma_t if is_torch(lib) else np.asarray(self.sigma_t)
        hint = "" if (sigma_t > 0).any() else f"; {CLEAR}"
        ok, bound = _between(sigma_t, EXTINCTIONS)
        _check("sigma_t = sigma_s + sigma_a", sigma_t, ok, f"{bound} (1/mm)", hint)

    @classmethod
    def from_albedo(cls, albedo: PerChannel, sigma_t: PerChannel, g: PerChannel = 0.0, eta: float = 1.3) -> Medium:
        """The medium with single-scattering albedo in [0, 1] and extinction sigma_t (1/mm).

        sigma_s = albedo sigma_t, sigma_a = (1 - albedo) sigma_t.
        """
        albedo, sigma_t = _coefficients(albedo=albedo, sigma_t=sigma_t).values()
        _check("albedo", albedo, (albedo >= 0) & (albedo <= 1), "in [0, 1]")
        _check("sigma_t", sigma_t, library(sigma_t).isfinite(sigma_t) & (sigma_t > 0), "finite and > 0 (1/mm)")
        _common_shape(albedo=albedo, sigma_t=sigma_t)
        return cls(albedo * sigma_t, (1 - albedo) * sigma_t, g, eta)

    @classmethod
    def from_reduced(
        cls, sigma_s_prime: PerChannel, sigma_a: PerChannel, g: PerChannel = 0.0, eta: float = 1.3
    ) -> Medium:
        """The medium whose reduced scattering is sigma_s_prime (1/mm): sigma_s = sigma_s_prime / (1 - g)."""
        sigma_s_prime, g = _coefficients(sigma_s_prime=sigma_s_prime, g=g).values()
        ok = library(sigma_s_prime).isfinite(sigma_s_prime) & (sigma_s_prime >= 0)
        _check("sigma_s_prime", sigma_s_prime, ok, "finite and >= 0 (1/mm)")
        _check("g", g, abs(g) < 1, "in the open interval (-1, 1)")
        _common_shape(sigma_s_prime=sigma_s_prime, g=g)
        return cls(sigma_s_prime / (1 - g), sigma_a, g, eta)

    @classmethod
    def from_reflectance(
        cls,
        reflectance: PerChannel,
        mfp: PerChannel,
        g: PerChannel = 0.0,
        eta: float = 1.3,
        mu_i: float | str = DIFFUSE,
    ) -> Medium:
        """The medium whose half-space has a wanted reflectance, with the mean free path mfp = 1 / sigma_t (mm).

        A mean free path of 0 in some channels is their diffuse limit, see `diffuse_limit`.

        What artists give: colour, radius and anisotropy (`subsurface_color`, `subsurface_radius` and
        `subsurface_scatter_anisotropy` of OpenPBR). `reflectance` is the fraction of incident flux that comes back out
        of the medium, without what the boundary mirrors, under uniform radiance from above ("diffuse") or at the cosine
        of incidence mu_i. Exact by discrete ordinates, to 1e-4 of itself; `Medium.reflectance` is the
        inverse. For a texture take `physics.reflectance.albedo_of_reflectance`.

        Raises:
            ValueError: a colour is out of reach at this eta, or another argument is out of range.
        """
        reflectance, mfp, g = (_number(n, v) for n, v in (("reflectance", reflectance), ("mfp", mfp), ("g", g)))
        mfp = diffuse_limit(mfp)
        _check("mfp", mfp, np.isfinite(mfp) & (mfp > 0), "finite and > 0 (mm), or 0 in some channels")
        _check("g", g, np.abs(g) < 1, "in the open interval (-1, 1)")
        shape = _common_shape(reflectance=reflectance, mfp=mfp, g=g)
        eta = _index("eta", eta)
        pairs = np.broadcast(reflectance, np.broadcast_to(g, shape))
        albedo = np.array([float(albedo_of_reflectance(R, float(k), eta, mu_i)) for R, k in pairs])
        return cls.from_albedo(albedo.reshape(pairs.shape), 1 / mfp, g, eta)

    @classmethod
    def from_openpbr(
        cls, subsurface_color: PerChannel, subsurface_radius: PerChannel = 1.0,
        subsurface_radius_scale: PerChannel = (1.0, 0.5, 0.25), subsurface_scatter_anisotropy: PerChannel = 0.0,
        specular_ior: float = 1.5, mm_per_unit: float = 1.0,
    ) -> Medium:  # fmt: skip
        """The medium of the subsurface slab of OpenPBR 1.1, in linear Rec. 709.

        The colour C is by definition the share of the light which enters that leaves again, seen along the normal
        under uniform light: R(mu = 1) = (1 - F_r(1)) C, with the smooth boundary and all orders. Here that is solved
        exactly, for any g and index. The van de Hulst fit that the standard shows is of a matched boundary: at index
        1.5 its medium of colour 0.5 is seen as 0.25. The mean free path is radius x scale, in units of `mm_per_unit`.

        Raises:
            ValueError: a colour outside [0, 1], or another argument out of range.
        """
        color, radius, scale, unit = (
            _number(name, value)
            for name, value in (
                ("subsurface_color", subsurface_color), ("subsurface_radius", subsurface_radius),
                ("subsurface_radius_scale", subsurface_radius_scale), ("mm_per_unit", mm_per_unit),
            )
        )  # fmt: skip
        _check("subsurface_color", color, (color >= 0) & (color <= 1), "in [0, 1]")
        _common_shape(subsurface_radius=radius, subsurface_radius_scale=scale, subsurface_color=color)
        enters = half_space_reflectance(1.0, 0.0, _index("specular_ior", specular_ior), 1.0)  # 1 - F_r(1)
        g = subsurface_scatter_anisotropy
        return cls.from_reflectance(enters * color, radius * scale * unit, g, specular_ior, mu_i=1.0)

    @classmethod
    def from_principled(
        cls, base_color: PerChannel, subsurface_radius: PerChannel = (1.0, 0.2, 0.1), subsurface_scale: float = 0.05,
        subsurface_anisotropy: PerChannel = 0.0, ior: float = 1.5, mm_per_unit: float = 1000.0,
    ) -> Medium:  # fmt: skip
        """The medium of the Principled BSDF of Blender 4 with the method Random Walk, in linear Rec. 709.

        Cycles has sigma_t = 4 pi / ((1 - g) radius x scale), in metres as Blender has them; `mm_per_unit` changes that.
        It means the base colour to be what enters and leaves again, and takes the albedo from a fit for a matched
        boundary; here it is solved as in `from_openpbr`, with the boundary of `ior`.

        Raises:
            ValueError: a colour outside [0, 1], or another argument out of range.
        """
        names = ("subsurface_radius", "subsurface_scale", "subsurface_anisotropy")
        given = (subsurface_radius, subsurface_scale, subsurface_anisotropy)
        radius, scale, g = (_number(name, value) for name, value in zip(names, given))
        _check("subsurface_anisotropy", g, np.abs(g) < 1, "in the open interval (-1, 1)")
        return cls.from_openpbr(base_color, scale * (1 - g) / (4 * np.pi), radius, g, ior, mm_per_unit)

    @classmethod
    def from_gltf(
        cls, multiscatter_color: PerChannel, attenuation_distance: float, attenuation_color: PerChannel,
        scatter_anisotropy: float = 0.0, ior: float = 1.5,
    ) -> Medium:  # fmt: skip
        """The medium of KHR_materials_volume_scatter with KHR_materials_volume of glTF, in linear Rec. 709.

        The extensions define the coefficients, not what is seen: sigma_t = -ln(attenuation_color) /
        attenuation_distance (metres), and with the multiscatter colour C the albedo 1 - s²,

            s = 4.09712 + 4.20863 C - sqrt(9.59217 + 41.6808 C + 17.7126 C²)   (Kulla and Conty 2017).

        For g = 0 and a matched boundary C is the reflectance under diffuse light within 0.01.

        Raises:
            ValueError: a colour outside [0, 1], an attenuation colour outside (0, 1), a distance that is not finite
                and > 0, or another argument out of range.
        """
        color, tint = _number("multiscatter_color", multiscatter_color), _number("attenuation_color", attenuation_color)
        distance = _number("attenuation_distance", attenuation_distance)
        _check("multiscatter_color", color, (color >= 0) & (color <= 1), "in [0, 1]")
        _check("attenuation_color", tint, (tint > 0) & (tint < 1), "in the open interval (0, 1)")
        _check("attenuation_distance", distance, np.isfinite(distance) & (distance > 0), "finite and > 0 (metres)")
        s = 4.09712 + 4.20863 * color - np.sqrt(9.59217 + 41.6808 * color + 17.7126 * color**2)
        return cls.from_albedo(np.clip(1 - s * s, 0, 1), -np.log(tint) / (1000 * distance), scatter_anisotropy, ior)

    def reflectance(self, mu_i: float | str = DIFFUSE) -> np.ndarray | float:
        """The fraction of incident flux that comes back out of the half-space, per channel, all orders.

        mu_i is the cosine of incidence, or "diffuse" for uniform radiance from above. Exact by discrete
        ordinates; left out is what the boundary mirrors.
        """
        check_numbers("medium", self)
        pairs = np.broadcast(self.albedo, self.g)
        result = np.array([half_space_reflectance(float(a), float(g), self.eta, mu_i) for a, g in pairs])
        return result if self.n_channels is not None else float(result[0])

    @property
    def n_channels(self) -> int | None:
        """Number of channels, None for a scalar medium."""
        return len(self.sigma_s) if np.ndim(self.sigma_s) else None

    @property
    def sigma_t(self) -> np.ndarray | float:
        """Extinction coefficient sigma_s + sigma_a, 1/mm."""
        return self.sigma_s + self.sigma_a

    @property
    def mfp(self) -> np.ndarray | float:
        """Mean free path 1 / sigma_t, mm."""
        return 1 / self.sigma_t

    @property
    def albedo(self) -> np.ndarray | float:
        """Single-scattering albedo sigma_s / sigma_t."""
        return self.sigma_s / self.sigma_t

    @property
    def sigma_s_prime(self) -> np.ndarray | float:
        """Reduced scattering coefficient (1 - g) sigma_s, 1/mm."""
        return (1 - self.g) * self.sigma_s

    @property
    def sigma_t_prime(self) -> np.ndarray | float:
        """Reduced extinction coefficient sigma_s_prime + sigma_a, 1/mm."""
        return self.sigma_s_prime + self.sigma_a

    @property
    def albedo_prime(self) -> np.ndarray | float:
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
        s, a, g = (v if self.n_channels is None else v[index] for v in (self.sigma_s, self.sigma_a, self.g))
        return Medium(s, a, g, self.eta)

    def channels(self) -> list[Medium]:
        """The scalar media of the channels; of a scalar medium itself."""
        return [self.channel(k) for k in range(self.n_channels or 1)]

    @property
    def has_derivatives(self) -> bool:
        """Whether torch records derivatives by the coefficients."""
        return is_torch(library(self.sigma_s))

    def detached(self) -> Medium:
        """The medium of the same numbers, without gradients."""
        if not self.has_derivatives:
            return self
        return Medium(*(v.detach().tolist() for v in (self.sigma_s, self.sigma_a, self.g)), self.eta)

    def __str__(self) -> str:
        """sigma_t (1/mm), albedo, g and eta; one number for each channel where they differ."""
        numbers = self.detached()
        parts = (
            ("sigma_t", numbers.sigma_t, "/mm"),
            ("albedo", numbers.albedo, ""),
            ("g", numbers.g, ""),
            ("eta", self.eta, ""),
        )
        return ", ".join(f"{name} {_short(value)}{unit}" for name, value, unit in parts)

    def _repr_html_(self) -> str:
        names = ("sigma_s", "sigma_a", "sigma_t", "albedo", "g", "mfp")
        units = {"sigma_s": "1/mm", "sigma_a": "1/mm", "sigma_t": "1/mm", "mfp": "mm"}
        head = "".join(f"<th>{name} {units.get(name, '')}</th>" for name in names)
        rows = "".join(
            "<tr>" + "".join(f"<td>{_short(getattr(m, name))}</td>" for name in names) + "</tr>"
            for m in self.detached().channels()
        )
        return f"<table><caption>medium, eta {self.eta:.4g}</caption><tr>{head}</tr>{rows}</table>"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Medium):
            return NotImplemented
        if self.has_derivatives or other.has_derivatives:
            return self is other
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in ("sigma_s", "sigma_a", "g", "eta"))

    def __hash__(self) -> int:
        if self.has_derivatives:
            return id(self)
        return hash(tuple(np.asarray(getattr(self, n)).tobytes() for n in ("sigma_s", "sigma_a", "g", "eta")))


def _short(value: float | np.ndarray) -> str:
    """To four digits; one number where all are the same."""
    results = [f"{x:.4g}" for x in np.atleast_1d(value).tolist()]
    return results[0] if len(set(results)) == 1 else " ".join(results)


def check_numbers(name: str, medium: Medium) -> None:
    """ValueError if torch records derivatives by the coefficients, which would be lost."""
    if medium.has_derivatives:
        raise ValueError(f"{name} must be of numbers (take medium.detached()), got tensors with derivatives: {medium}")


def check_scalar_medium(medium: object) -> None:
    if not isinstance(medium, Medium):
        raise ValueError(f"medium must be a Medium, got {type(medium).__name__}")
    if medium.n_channels is not None:
        raise ValueError(f"medium must have one channel (take medium.channel(k)), got {medium.n_channels} channels")
    check_numbers("medium", medium)


def medium_of(given: object) -> Medium:
    """The medium of a material; anything else as it is, but for names, which `materials.load` takes.
    ValueError if it is a name."""
    if isinstance(given, str):
        hint = f"`halfspace_sss.materials.load({given!r})` has the material of a name"
        raise ValueError(f"medium must be a Medium or a Material, got {given!r}; {hint}")
    return getattr(given, "medium", given)


def eval_hg(cos_theta: Real, g: Real) -> Real:
    """Henyey-Greenstein phase function p(cos_theta), 1/sr.

    p = (1 - g²) / (4 pi (1 + g² - 2 g cos_theta)^(3/2)), cos_theta = 1 forward. The bracket is
    evaluated as (1 - |g|)² + 2 |g| (1 -+ cos_theta), which keeps its digits for |g| -> 1.

    Args:
        cos_theta: cosine between the directions of travel before and after, [-1, 1].
        g: mean cosine, (-1, 1).

    Source: Henyey and Greenstein 1941.
    """
    lib = library(cos_theta, g)
    if isinstance(g, (int, float)):
        size, aligned = abs(g), math.copysign(1, g) * cos_theta
    else:  # abs has no derivative at 0, where p has 3 cos_theta / (4 pi)
        size, aligned = lib.where(g >= 0, g, -g), lib.where(g >= 0, cos_theta, -cos_theta)
    gap = lib.maximum((1 - size) * (1 - size) + 2 * size * (1 - aligned), 1e-30)
    return (1 - size) * (1 + size) / (4 * math.pi * gap * lib.sqrt(gap))


def sample_hg(u: Real, g: Real) -> Real:
    """Cosine of the scattering angle for a uniform number u in [0, 1).

    cos = 1 - (1 - g) (1 - u) (1 - g + q) / b with b = 1 - g + 2gu, q = (1 - g²) / b: the published
    (1 + g² - q²) / (2g) without its division by g, so that it holds for every g, 0 included, and keeps its digits.
    The azimuth about the old direction is uniform and left to the caller; the density per solid angle is `eval_hg`.
    """
    lib = library(u, g)
    ratio = (1 - g) / (1 - g + 2 * g * u)
    return lib.maximum(1 - ratio * (1 - u) * (1 - g + ratio * (1 + g)), -1.0)


@dataclass(frozen=True)
class Layers:
    """Homogeneous media in layers parallel to the plane z = 0, the first on top.

    Args:
        media: scalar media (or materials with one channel); the eta of each is its index over that above the plane,
            at least 1, so that the step from layer k to the next is eta_{k+1} / eta_k. A clear one has sigma_s = 1e-9.
        thickness: of each layer in mm, > 0. With one number fewer than media the last layer is semi-infinite; with as
            many the stack is a slab.
        eta_below: index below a slab over that above the plane, > 0.

    Raises:
        ValueError: no layer, a coloured medium, an index below 1, a thickness that is not finite and > 0, another
            number of thicknesses, or `eta_below` without a slab.
    """

    media: Sequence[Medium]
    thickness: Sequence[float] = ()
    eta_below: float = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.media, Medium) or not isinstance(self.media, Sequence) or not self.media:
            raise ValueError(f"media must be a list of one medium or more, got {self.media!r}")
        media = []
        for k, given in enumerate(self.media, 1):
            try:
                media.append(medium := medium_of(given))
                check_scalar_medium(medium)
            except ValueError as error:
                raise ValueError(f"layer {k}: {error}") from None
            if medium.eta < 1:
                raise ValueError(f"layer {k}: eta must be >= 1, got {medium.eta!r}")
        thickness = self._checked_thickness(len(media))
        if not (_is_number(self.eta_below) and 0 < self.eta_below < math.inf):
            raise ValueError(f"eta_below must be finite and > 0, got {self.eta_below!r}")
        if self.eta_below != 1 and len(thickness) < len(media):
            raise ValueError(f"eta_below must be left out below a semi-infinite layer, got {self.eta_below!r}")
        object.__setattr__(self, "media", tuple(media))
        object.__setattr__(self, "thickness", thickness)

    def _checked_thickness(self, layers: int) -> tuple[float, ...]:
        given = self.thickness
        if _is_number(given):
            given = (given,)
        if isinstance(given, str) or not all(_is_number(d) for d in given):
            raise ValueError(f"thickness must be numbers in mm, got {given!r}")
        if len(given) not in (layers - 1, layers):
            allowed = f"{layers - 1} (the last layer semi-infinite) or {layers} (a slab)"
            raise ValueError(f"thickness must have {allowed} numbers for {layers} media, got {len(given)}")
        for k, d in enumerate(given, 1):
            if not 0 < d < math.inf:
                raise ValueError(f"thickness of layer {k} must be finite and > 0 (mm), got {d!r}")
        return tuple(float(d) for d in given)

    def __len__(self) -> int:
        return len(self.media)

    @property
    def eta(self) -> float:
        """Index of the first layer over that above the plane."""
        return self.media[0].eta

    @property
    def is_slab(self) -> bool:
        """Whether the last layer ends."""
        return len(self.thickness) == len(self.media)


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)
