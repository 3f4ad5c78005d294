"""The Mitsuba integrator `bssrdf`: paths that enter translucent objects through the BSSRDF of the half-space."""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.light.interruptible import interruptible
from halfspace_sss.rendering.paths.differentiable import check_outermost, check_parameters, replayer
from halfspace_sss.rendering.paths.gathering import Gathering
from halfspace_sss.rendering.paths.launches import launches
from halfspace_sss.rendering.paths.tracing import trace_paths
from halfspace_sss.rendering.transport.body import Bodies, make_bodies
from halfspace_sss.rendering.transport.settings import read_settings

__all__ = ["integrator_class"]


def integrator_class() -> type:
    """The class of the integrator for the current variant of Mitsuba."""

    class BSSRDFIntegrator(mi.SamplingIntegrator):
        """Renders scenes with `translucent` objects; parameters as in `Settings`.

        An object whose model has to learn it, and has not, is learnt while the scene is prepared, from walks that do
        not serve the image; `rendering.scenes.online.render` and `halfspace-sss render` use them for both.

        Images can be differentiated by emitters, surfaces, textures and the medium of each object (`albedo`, `sigma_t`,
        `g`), forward and backward; where paths go is held, and derivatives by geometry are refused.
        """

        def __init__(self, props: Any) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.timed = float(props.get("timeout", -1.0)) > 0
            self.settings = read_settings(props)
            self._bodies = Bodies(self.settings)
            self._gathering = Gathering()

        def prepare(self, scene: Any) -> list[Any]:
            """The translucent objects of a scene, made ready once; ValueError if the scene cannot be rendered."""
            check_parameters(scene)
            with dr.suspend_grad():
                return self._prepared(scene)

        def _prepared(self, scene: Any) -> list[Any]:
            bodies = self._bodies.of(scene)
            if self.settings.light == "sampled":
                return bodies
            return self._gathering.of(scene, bodies, self.settings)

        def check(self, scene: Any, without: Collection[str] = ()) -> None:
            """ValueError if the scene cannot be rendered, as far as can be told without the objects `without`."""
            check_parameters(scene)
            with dr.suspend_grad():
                make_bodies(scene, self.settings, without)

        def render(
            self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
        ) -> Any:
            """The image, in launches; KeyboardInterrupt between two if one was interrupted."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with interruptible(), undisturbed(), dr.suspend_grad():
                self.prepare(scene)
                for launch in launches(sensor, seed, spp, lambda: not self.timed and self.should_stop()):
                    super().render(scene, sensor=sensor, seed=launch.seed, spp=launch.spp, develop=True)
                return sensor.film().develop() if develop else None

        def render_forward(self, scene: Any, *args: Any, **more: Any) -> Any:
            bodies = self._differentiable(scene)
            with undisturbed():
                return replayer(bodies, self.settings).render_forward(scene, *args, **more)

        def render_backward(self, scene: Any, *args: Any, **more: Any) -> None:
            bodies = self._differentiable(scene)
            with undisturbed():
                replayer(bodies, self.settings).render_backward(scene, *args, **more)

        def _differentiable(self, scene: Any) -> list[Any]:
            if self.settings.light != "sampled":
                raise ValueError(f"light must be sampled for derivatives, got {self.settings.light}")
            return self.prepare(scene)

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> tuple:
            check_outermost(scene)
            with undisturbed(), dr.suspend_grad():
                parts, seen = trace_paths(scene, self._prepared(scene), self.settings, sampler, ray, active)
            return parts[0] + parts[1], seen, []

        @property
        def gathered(self) -> list[str]:
            """A sentence on the light that was gathered for each object, with its noise."""
            return self._gathering.told()

        def to_string(self) -> str:
            return f"BSSRDFIntegrator[{self.settings}]"

    return BSSRDFIntegrator


@contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage collection while a kernel is recorded.

    It would free objects of earlier scenes. A call that is recorded before that has other targets than the same call
    after it, and Dr.Jit then writes the same function twice, which LLVM refuses.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
