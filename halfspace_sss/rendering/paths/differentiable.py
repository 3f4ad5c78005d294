"""What a render can be differentiated by, and Mitsuba's machinery of forward and backward passes around a replay."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.tracing import replay_paths, trace_paths
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.settings import Settings

__all__ = ["check_outermost", "check_parameters", "replayer"]

GEOMETRY = ("to_world", "vertex_positions", "vertex_normals", "vertex_texcoords")


def check_parameters(scene: Any) -> None:
    """Refuse derivatives that a replay with fixed paths does not have.

    Raises:
        ValueError: gradients are enabled for the geometry of a shape, for a sensor or film, or for what Mitsuba does
            not differentiate by, such as the index of a smooth dielectric.
    """
    parameters = mi.traverse(scene)
    for key, (_, _, owner, flags) in parameters.properties.items():
        with dr.resume_grad():
            if not dr.grad_enabled(parameters[key]):
                continue
        name = key.rsplit(".", 1)[-1]
        fixed = bool(flags & int(mi.ParamFlags.NonDifferentiable))
        if fixed or name in GEOMETRY or _moves(owner, name) or _selects(parameters, owner, name):
            raise ValueError(
                f"{key} must not have gradients enabled: bssrdf differentiates light by emitters, surfaces, textures "
                "and media, with paths held where they are"
            )


def check_outermost(scene: Any) -> None:
    """Refuse derivatives of another integrator that asks this one for samples: they would be missing in silence.

    Raises:
        ValueError: gradients are enabled for a parameter of the scene, and followed.
    """
    followed = [key for key, value in mi.traverse(scene).items() if dr.grad_enabled(value)]
    if followed:
        raise ValueError(
            f"bssrdf must be the outermost integrator for derivatives, got one around it for {followed[0]}"
        )


def _moves(owner: Any, name: str) -> bool:
    """Whether a parameter moves a shape or a sensor; attributes of vertices and faces are textures."""
    if isinstance(owner, mi.Shape):
        return not name.startswith(("vertex_", "face_"))
    return isinstance(owner, (mi.Sensor, mi.Film))


def _selects(parameters: Any, owner: Any, name: str) -> bool:
    """Whether a parameter does more than scale light: the share of a mirror in a blend, the index that a medium has."""
    while owner is not None:
        if isinstance(owner, mi.BSDF) and owner.class_name() == "BlendBSDF":
            return bool(owner.flags() & int(mi.BSDFFlags.Delta))
        owner = parameters.hierarchy[owner][0]
        if hasattr(owner, "inside") and name == "eta":
            return True
    return False


def replayer(bodies: list[Body], settings: Settings) -> Any:
    """An integrator of Mitsuba's radiative backpropagation around the paths through a scene with these bodies.

    Raises:
        ValueError: gradients are enabled for a medium, and the model knows no other.
    """
    from mitsuba.python.ad.integrators.common import RBIntegrator

    for body in bodies:
        body.variation.prepare()

    class Replayer(RBIntegrator):
        """Mitsuba's camera rays and films, this project's paths."""

        def sample(self, mode: Any, scene: Any, sampler: Any, ray: Any, **given: Any) -> tuple:
            if mode == dr.ADMode.Primal:
                parts, seen = trace_paths(scene, bodies, settings, sampler, ray, given["active"])
                return parts[0] + parts[1], seen, [], parts
            parts, backward = given["state_in"], mode == dr.ADMode.Backward
            d = replay_paths(scene, bodies, settings, sampler, ray, parts, given["δL"], backward)
            return d, mi.Bool(True), [], parts

    return Replayer(mi.Properties())
