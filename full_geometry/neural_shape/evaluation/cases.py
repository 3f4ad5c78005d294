"""Errors of the network of all shapes on held-out shapes and media, a mesh, spheres; and what an evaluation costs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from full_geometry.half_space import HalfSpaceTransport
from full_geometry.learning.model_errors import LIGHTS, ModelError, errors_of
from full_geometry.neural_shape.learning.drawing import draw_subject
from full_geometry.neural_shape.mixing import mean_chord
from full_geometry.neural_shape.shapes.generators import HELD_OUT
from full_geometry.neural_shape.storing import transport
from full_geometry.subject import Subject
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.materials import load as load_material
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["HALF_SPACES", "Case", "Row", "evaluate", "held_out", "of_mesh", "seconds_per_million", "spheres"]

HALF_SPACES = ("neural", "better_dipole", "directional_dipole")
EXITS, WALKS, SAMPLES = 128, 4096, 4096
DARK, MORE = 0.5, 12  # reduced albedo below which most walks end inside, and how many more there are
RADII = (1.0, 3.0, 10.0, 30.0)  # mean free paths
LANES = 2**18
HELD_OUT_SEED = 77


@dataclass(frozen=True, eq=False)
class Case:
    """An object to be evaluated.

    Args:
        name: of shape and medium.
        subject: the object.
    """

    name: str
    subject: Subject


@dataclass(frozen=True)
class Row:
    """One channel of a case: what it is, and (error, standard error) under constant light and under lobes by model."""

    name: str
    size: float
    albedo: float
    g: float
    eta: float
    thickness: float
    errors: Mapping[str, Mapping[str, tuple[float, float]]]

    def of(self, model: str, light: str = "constant") -> float:
        """Error of a model."""
        return self.errors[model][light][0]

    def best(self, light: str = "constant") -> tuple[str, float]:
        """The best half-space model and its error."""
        name = min((m for m in self.errors if m != "neural_shape"), key=lambda m: self.of(m, light))
        return name, self.of(name, light)


def held_out(n: int) -> Iterator[Case]:
    """Objects of the families that were not trained on, each family in turn; media and sizes as in training."""
    families = tuple(HELD_OUT)
    for k in range(n):
        family = families[k % len(families)]
        yield Case(family, draw_subject((HELD_OUT_SEED, 10**6 + k), (family,)).subject)


def of_mesh(path: str | Path, materials: Sequence[str], mm_per_unit: float) -> Iterator[Case]:
    """A mesh of each channel of materials of the registry."""
    import mitsuba as mi

    for material in materials:
        medium = load_material(material).medium
        for k, channel in enumerate("RGB"):
            shape = mi.load_dict({"type": "ply", "filename": str(path)})
            yield Case(f"{material} {channel}", Subject.of(shape, medium.channel(k), mm_per_unit))


def spheres(albedo: float = 0.95, eta: float = 1.3) -> Iterator[Case]:
    """Spheres of 1, 3, 10 and 30 mean free paths."""
    import mitsuba as mi

    for radius in RADII:
        shape = mi.load_dict({"type": "sphere", "radius": radius})
        yield Case(f"sphere of {radius:g} mfp", Subject.of(shape, Medium(albedo, 1 - albedo, 0.0, eta)))


def evaluate(
    cases: Iterator[Case], n: int, *, seed: int = 0, progress: NamedProgress | None = None, path: Path | None = None
) -> list[Row]:
    """The errors of the network and of the half-space models.

    Args:
        cases: objects, of one channel each.
        n: how many there are.
        seed: of exits, walks and entries.
        progress: called with (what, done, total).
        path: of other weights.
    """
    rows = []
    for k, case in enumerate(cases):
        if progress:
            progress(case.name, k, n)
        subject = case.subject
        models: dict[str, Any] = {"neural_shape": transport(subject, path)}
        models |= {name: HalfSpaceTransport(subject, name) for name in HALF_SPACES if _takes(name, subject)}
        walks = WALKS * (MORE if float(subject.media[0].albedo_prime) < DARK else 1)
        found = errors_of(subject, models, exits=EXITS, walks=walks, samples=SAMPLES, seed=seed)
        rows.append(_row(case, found))
    return rows


def _takes(name: str, subject: Subject) -> bool:
    """Whether a half-space model takes the medium and has its orders two and more."""
    try:
        return bssrdf(name, subject.media[0]).orders == "multiple"
    except ValueError:
        return False


def _row(case: Case, found: Mapping[str, list[ModelError]]) -> Row:
    m = case.subject.media[0]
    errors = {
        model: {light: next((r.error, r.standard_error) for r in rows if r.light == light and r.channel == 0)
                for light in LIGHTS}
        for model, rows in found.items()
    }  # fmt: skip
    size = float(case.subject.mean_free_paths()[0])
    thickness = mean_chord(case.subject) * float(m.sigma_t)
    return Row(case.name, size, float(m.albedo), float(m.g), m.eta, thickness, errors)


def seconds_per_million(subject: Subject, path: Path | None = None) -> dict[str, float]:
    """Seconds for a million evaluations, entry and exit prepared anew, of the network and of half-space models."""
    import drjit as dr
    import mitsuba as mi

    models: dict[str, Any] = {"neural_shape": transport(subject, path)}
    models |= {name: HalfSpaceTransport(subject, name) for name in HALF_SPACES}
    rng = generator(mi, LANES, pass_seed(29))
    exits, entries = subject.random_points(rng), subject.random_points(rng)
    dr.eval(exits, entries)
    found = {}
    for name, model in models.items():
        times = []
        for _ in range(3):  # the first one compiles
            dr.sync_thread()
            at = time.perf_counter()
            dr.eval(model.S(model.prepare(exits), entries))
            dr.sync_thread()
            times.append(time.perf_counter() - at)
        found[name] = 1e6 / LANES * min(times[1:])
    return found
