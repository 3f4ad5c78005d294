"""The Mitsuba integrator `bssrdf`: paths that enter translucent objects through the BSSRDF of the half-space."""

from __future__ import annotations

from typing import Any

from halfspace_sss.rendering.paths import trace_paths
from halfspace_sss.rendering.surface.object import same_objects
from halfspace_sss.rendering.transport.body import make_bodies
from halfspace_sss.rendering.transport.settings import read_settings

__all__ = ["integrator_class"]


def integrator_class() -> type:
    """The class of the integrator for the current variant of Mitsuba."""
    import mitsuba as mi

    class BSSRDFIntegrator(mi.SamplingIntegrator):
        """Renders scenes with `translucent` objects; parameters as in `Settings`."""

        def __init__(self, props: Any) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.settings = read_settings(props)
            self._prepared: tuple[list, list] = ([], [])

        def prepare(self, scene: Any) -> list[Any]:
            """The translucent objects of a scene, made ready once; ValueError if the scene cannot be rendered."""
            shapes = scene.shapes()  # the scene itself, which holds its integrator, would never be freed
            if not self._prepared[1] or not same_objects(self._prepared[0], shapes):
                self._prepared = shapes, make_bodies(scene, self.settings)
            return self._prepared[1]

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list]:
            L, seen = trace_paths(scene, self.prepare(scene), self.settings, sampler, ray, active)
            return L, seen, []

        def to_string(self) -> str:
            return f"BSSRDFIntegrator[{self.settings}]"

    return BSSRDFIntegrator
