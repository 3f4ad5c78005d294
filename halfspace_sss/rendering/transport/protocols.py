"""The two words the path loop knows of a model: where light may enter for an exit, and what it is worth there.

A *proposal* draws an entry and the direction that light comes from, with densities; a *transport* gives S for an exit
and an entry. A half-space model laid onto the surface is one transport, a network that knows the object another.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import drjit as dr

from halfspace_sss.rendering.surface.horizon import cosine_above, cosine_density, lifted
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.plane import Exit

__all__ = ["CosineProposals", "Entry", "Means", "Proposals", "Transport"]


class Entry(NamedTuple):
    """A point of entry: position, geometric and outward shading normal, weight 1/density (0: none was found), face."""

    p: Any
    n: Any
    n_out: Any
    weight: Any
    face: Any

    @property
    def n_face(self) -> Any:
        """The geometric normal, outwards."""
        return turned(self.n, self.n_out)

    def seen(self, w: Any) -> tuple[Any, Any]:
        """The outward shading normal that w sees, see `surface.horizon`, and the cosine to it; 0 below the surface."""
        n_face = self.n_face
        n_out = lifted(self.n_out, n_face, w)
        return n_out, dr.select(dr.dot(w, n_face) > 0, dr.maximum(dr.dot(w, n_out), 0), 0)


class Proposals(Protocol):
    """Where light that leaves at an exit may have entered."""

    def prepare(self, out: Exit, prepared: Any, active: Any) -> Any:
        """What is done once for all entries of an exit; `prepared` is what the transport has made of it."""

    def sample(self, out: Exit, prim_index: Any, prepared: Any, sampler: Any, active: Any) -> Entry:
        """A point of entry; its weight is the inverse of the density of such points over the surface, (scene unit)²."""

    def sample_direction(self, entry: Entry, out: Exit, u: Any) -> tuple[Any, Any]:
        """A direction w_i that points away from the surface at the entry, for a pair of uniforms, and its density.

        The density is over solid angle, 1/sr.
        """

    def pdf_direction(self, entry: Entry, out: Exit, w_i: Any) -> Any:
        """The density of `sample_direction`, 1/sr; 0 below the surface."""


class CosineProposals(Proposals, Protocol):
    """Proposals whose directions are by the cosine to the interpolated normal, above the surface."""

    def sample_direction(self, entry: Entry, out: Exit, u: Any) -> tuple[Any, Any]:
        return cosine_above(entry.n_out, entry.n_face, u)

    def pdf_direction(self, entry: Entry, out: Exit, w_i: Any) -> Any:
        return cosine_density(entry.n_out, entry.n_face, w_i)


class Transport(Protocol):
    """S of one object, for any exit and entry.

    One that knows what it is under the same light from everywhere also has `alpha(out, active)`: the share of it that
    leaves at an exit, per channel, by orders below two and by those of S, ∫ S mu_i dw_i dA_i, and `evened`, two spectra
    that are 1 in the channels where these are known; elsewhere they are 0. The path loop takes the mean light of the
    sky so.

    Attributes:
        orders: "multiple" (two or more scattering events) or "total".
        checksums: of what it has learnt, which are part of a render's identity; empty where nothing is.
    """

    orders: str
    checksums: tuple[str, ...]

    def prepare(self, out: Exit, active: Any) -> Any:
        """What is done once for all entries of an exit, handed to `S_mu` as it is."""

    def S_mu(self, prepared: Any, entry: Entry, w_i: Any, active: Any) -> Any:
        """S(x_i, w_i; x_o, w_o) mu_i for each channel, 1/((scene unit)² sr); 0 below the horizons."""


class Means(NamedTuple):
    """What renders an object inside: a transport, the proposals that suit it, and how many entries an exit draws."""

    transport: Transport
    proposals: Proposals
    entries: int = 1
