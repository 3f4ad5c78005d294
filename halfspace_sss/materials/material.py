"""A material: a medium with its name, where its numbers come from and what was assumed."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from types import MappingProxyType

import numpy as np

from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf, models_of

LONGEST_NAME = 80  # bytes in UTF-8; file systems end at 255


def key_of(name: str) -> str:
    """What of a name counts in a look-up: its letters and digits, whatever the case, and `&` as `and`."""
    return "".join(c for c in name.casefold().replace("&", "and") if c.isalnum())


def _check_name(name: str) -> None:
    if not key_of(name):
        raise ValueError(f"name must contain a letter or a digit, got {name!r}")
    wrong = [c for c in name if c in '/\\<>:"|?*' or not c.isprintable()]
    if wrong:
        raise ValueError(f"name must be without {wrong[0]!r}, as folders are called by it, got {name!r}")
    if name.startswith(".") or name.endswith(".") or name != name.strip():
        raise ValueError(f"name must neither begin nor end with a dot or a space, got {name!r}")
    if len(name.encode()) > LONGEST_NAME:
        raise ValueError(f"name must have at most {LONGEST_NAME} bytes, got {len(name.encode())}: {name[:20]!r}...")


@dataclass(frozen=True)
class Material:
    """A named medium with its provenance.

    Args:
        name: name in the registry, which folders may be called by; case and separators do not count.
        medium: its optical properties, 1/mm.
        channels: names of the channels of `medium`, e.g. ("R", "G", "B"); None for a medium with one channel.
        set: the group it was published in, e.g. "Jensen2001".
        source: the publication.
        assumptions: what was not measured and which value was taken.
        note: anything else a user should know, e.g. typing errors in public copies.
        sources: where the numbers come from, by quantity ("sigma_a", "g", ...).
        g_assumed: whether only sigma_s_prime is known, so that `with_g` may choose g.
        dilutable: whether it mixes with water, so that `diluted` makes sense.
        published_dilution: volume fraction at which it was measured, None if not known or not diluted.
        dilution: volume fraction that `medium` stands for, 1 for the pure material.

    Raises:
        ValueError: an argument is of the wrong kind or out of range, or channels do not match the medium.
    """

    name: str
    medium: Medium
    channels: tuple[str, ...] | None = None
    set: str = "user"
    source: str = "not stated"
    assumptions: tuple[str, ...] = ()
    note: str = ""
    sources: Mapping[str, str] = field(default_factory=dict, hash=False)
    g_assumed: bool = False
    dilutable: bool = False
    published_dilution: float | None = None
    dilution: float = 1.0

    def __post_init__(self) -> None:
        for name in ("name", "set", "source"):
            value = getattr(self, name)
            if not isinstance(value, str) or not value.strip():
                raise ValueError(f"{name} must be a text that is not empty, got {value!r}")
        _check_name(self.name)
        if not isinstance(self.medium, Medium):
            raise ValueError(f"medium must be a Medium, got {type(self.medium).__name__}")
        n = None if self.channels is None else len(self.channels)
        if n != self.medium.n_channels:
            raise ValueError(f"channels must match the {self.medium.n_channels} of medium, got {self.channels!r}")
        for name in ("dilution", "published_dilution"):
            if getattr(self, name) is not None:
                _check_fraction(name, getattr(self, name))
        for name in ("channels", "assumptions"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(getattr(self, name)))
        # the registry hands out one object to all callers, so none of them may change it
        object.__setattr__(self, "sources", MappingProxyType(dict(self.sources)))

    def _repr_html_(self) -> str:
        """The table of the medium under name, set and source."""
        return f"<p>{escape(f'{self.name}, {self.set}: {self.source}')}</p>{self.medium._repr_html_()}"

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "sources": dict(self.sources)}

    def diluted(self, fraction: float) -> Material:
        """The material mixed with water to the volume fraction `fraction` in (0, 1] of what it is now.

        sigma_s and sigma_a are multiplied by the fraction, g and eta stay; the absorption of water is left out.

        Raises:
            ValueError: fraction is out of range, or the material does not mix with water.
        """
        _check_fraction("dilution", fraction)
        if not self.dilutable:
            raise ValueError(f"dilution must be left out for {self.name!r}, which is not dilutable, got {fraction!r}")
        return replace(
            self,
            medium=self.medium.scaled(fraction),
            dilution=self.dilution * float(fraction),
            assumptions=(*self.assumptions, f"volume fraction {fraction:g} in water, absorption of water neglected"),
        )

    def with_g(self, g: float) -> Material:
        """The material with another mean cosine and the same reduced scattering: sigma_s = sigma_s_prime / (1 - g).

        Args:
            g: mean cosine in (-1, 1), a number or one per channel.

        Raises:
            ValueError: g is out of range, or the g of this material is known.
        """
        if not self.g_assumed:
            raise ValueError(f"g must be left out for {self.name!r}, whose g is {_plain(self.medium.g)}, got {g!r}")
        m = self.medium
        if np.shape(g) not in ((), np.shape(m.sigma_a)):
            raise ValueError(f"g must be a number or have one value for each of {self.channels!r}, got {g!r}")
        medium = Medium.from_reduced(m.sigma_s_prime, m.sigma_a, g, m.eta)
        return replace(self, medium=medium, assumptions=(*self.assumptions, f"g = {_plain(g)} asked for"))

    def models(self) -> tuple[str, ...]:
        """Names of the models that `bssrdf` can make for this material; a model that refuses its medium is left out."""
        return tuple(model.name for model in models_of(self.medium))

    def bssrdf(self, model: str) -> BSSRDF:
        """The BSSRDF of this material by the model of that name.

        Raises:
            ValueError: there is no such model, or it refuses the medium.
        """
        return bssrdf(model, self.medium)


def _check_fraction(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value) or not 0 < value <= 1:
        raise ValueError(f"{name} must be a volume fraction in (0, 1], got {value!r}")


def _plain(value: object) -> object:
    return np.asarray(value).tolist()
