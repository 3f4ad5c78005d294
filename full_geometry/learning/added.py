"""The transport of an object by the name of its model; those that packages add for renders are asked alike."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

from full_geometry.half_space import HalfSpaceTransport
from full_geometry.storing import KIND, find_weights, load
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.checks import check_choice
from halfspace_sss.rendering.surface.inside import Inside
from halfspace_sss.rendering.surface.transports import knows_objects, model_names, object_transport
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.protocols import Entry, Transport
from halfspace_sss.rendering.transport.settings import Settings

__all__ = ["AddedTransport", "transport"]


@dataclass(frozen=True, eq=False)
class AddedTransport:
    """A transport of an entry point of `halfspace_sss.transports`.

    Args:
        subject: the object.
        inner: what renders would use.
    """

    subject: Subject
    inner: Transport

    @classmethod
    def of(cls, subject: Subject, name: str) -> AddedTransport:
        """The one of that name, of an object.

        Raises:
            ValueError: as it raises, or it has no S for two points of a surface.
        """
        make = object_transport(name)
        inside = Inside("medium", subject.media[0], name, "total", True)
        inner = make(subject.found, inside, list(subject.media), Settings()).transport if make else None
        if inner is None or getattr(inner, "is_delta", False):
            raise ValueError(f"model must be one that has S for two points of a surface, got {name!r}")
        return cls(subject, inner)

    @property
    def orders(self) -> str:
        return self.inner.orders

    def prepare(self, at: SurfacePoint, active: Any = True) -> Any:
        """What is done for the exit alone."""
        return self.inner.prepare(Exit(at.p, at.n_out, at.w, number(self.subject.found.sign), at.n), active)

    def S(self, exit: Any, at: SurfacePoint, active: Any = True) -> Any:
        """S per channel, 1/((scene unit)² sr); 0 below the horizons."""
        import drjit as dr
        import mitsuba as mi

        mu = dr.dot(at.w, at.n_out)
        entry = Entry(at.p, mi.Normal3f(at.n * number(self.subject.found.sign)), at.n_out, mi.Float(1), mi.UInt32(0))
        value = self.inner.S_mu(exit, entry, at.w, active)
        return dr.select(mu > 0, value / dr.maximum(mu, 1e-6), 0)


def transport(subject: Subject, model: str, folder: str | os.PathLike | None = None) -> Any:
    """The transport called `model` of an object: "full_geometry", one that a package adds, or a half-space model.

    Raises:
        ValueError: the object has not been trained, or there is no such model.
    """
    check_choice("model", model, model_names())
    if model == KIND:
        return load(find_weights(subject, folder), subject).model
    if knows_objects(model):
        return AddedTransport.of(subject, model)
    return HalfSpaceTransport(subject, model)
