"""The fit: Adam on images of a scene, by unbiased gradients and an unbiased loss.

With two renders I, I' of independent samples, an image T and weights w, the loss of a view is

    mean w (I - T) (I' - T),    gradient 2 mean w ((I + I') / 2 - T) dI'',

where dI'' has samples of its own, so that noise has no bias in either (Deng et al. 2022 take the product too).
Weights are 1, or 1 / (T + a tenth of the mean of T)².
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.inverse.parameters import FitParameters, translucent_object
from halfspace_sss.inverse.views import GivenView, check_views
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import ProgressText
from halfspace_sss.provenance import check_folder, write_atomically
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, open_scene

LOSSES = ("relative", "l2")
FLOOR = 0.1  # of the mean of an image, added to it in relative weights
SETTLING = 0.5  # part of the steps after which the rate falls, to LAST of itself
LAST = 0.1
EXPOSURE = 10.0  # most, of a factor
AVERAGED = 0.25  # last part of the steps, over which variables are averaged
WALK = "translucent_walk"
PURPOSES = ("order", "first", "second", "gradient", "slope", "other slope", "test", "other test")


@dataclass(frozen=True)
class FitSettings:
    """How to fit.

    Args:
        steps: of Adam.
        spp: samples a pixel of each of the three renders of a view.
        batch: views a step; 0 takes 4 or all, whichever is less.
        rate: of Adam; it falls to a tenth over the second half of the steps.
        loss: "relative" or "l2".
        exposure: whether each image may have a factor of its own, of geometric mean 1.
        seed: of all samples.
    """

    steps: int = 150
    spp: int = 64
    batch: int = 0
    rate: float = 0.05
    loss: str = "relative"
    exposure: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("spp", 1), ("batch", 0), ("seed", 0)):
            check_count(name, getattr(self, name), least)
        check_interval("rate", self.rate, 1e-6, 10.0)
        check_choice("loss", self.loss, LOSSES)


class FitStep(NamedTuple):
    """Loss of the views of a step, its standard error by noise, and the parameters before it."""

    loss: float
    error: float
    values: dict[str, list[float]]


@dataclass(frozen=True)
class MaterialFit:
    """What was found.

    Args:
        values: of each parameter; sigma_t in 1/mm, mfp in mm.
        errors: standard errors by the Gauss-Newton matrix and the misfit.
        correlation: of all numbers in the order of `values`.
        medium: of the object.
        misfit: root of the loss of all fitted views at the end; 0 if noise takes the loss below 0.
        held_out: likewise of views held out; None without any.
        exposures: factor by which each view's image of the medium is multiplied to match the given one.
        told: sentences about bounds and about what the images do not tell.
        steps: the way there.
    """

    values: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    correlation: np.ndarray
    medium: Medium
    misfit: float
    held_out: float | None
    exposures: list[float]
    told: list[str]
    steps: list[FitStep] = field(repr=False)


def fit(
    scene: mi.Scene | dict | str | Path,
    images: Sequence[GivenView],
    parameters: Sequence[str] = ("albedo", "sigma_t"),
    model: str | None = WALK,
    object: str | None = None,  # noqa: A002
    settings: FitSettings | None = None,
    work: str | Path | None = None,
    progress: ProgressText | None = None,
) -> MaterialFit:
    """The medium of an object from images of it; it begins with the medium that the scene says, and changes the scene.

    Args:
        scene: a Mitsuba scene, a dict or an XML file, with cameras and lights as they were.
        images: views of it.
        parameters: names of `parameters.NAMES`.
        model: `translucent_walk` or the name of a model; None, and a Mitsuba scene, keep the integrator.
        object: name of the object; without it there must be one only.
        settings: how.
        work: a folder where each step is kept; the same fit started again goes on there, with the same bits.
        progress: called after each step.

    Raises:
        ValueError: an argument is out of range, views do not belong to the scene, none shows the object, or `work` is
            that of another fit.
    """
    settings = settings or FitSettings()
    if not isinstance(scene, mi.Scene):
        scene = open_scene(scene, PATH_TRACED if model == WALK else model)
    shape = translucent_object(scene, object)
    integrator = scene.integrator()
    mm_per_unit = getattr(integrator, "mm_per_unit", None) or integrator.settings.mm_per_unit
    variables = FitParameters.of(parameters, shape, mm_per_unit)
    check_views(scene, images, shape)
    descent = MediumDescent(scene, list(images), variables, settings, None if work is None else check_folder(work))
    descent.run(progress)
    return descent.result()


class MediumDescent:
    """Adam on the variables of a medium.

    Args:
        scene, views, parameters, settings: as of `fit`, checked.
        work: where steps are kept.
    """

    def __init__(
        self,
        scene: mi.Scene,
        views: list[GivenView],
        parameters: FitParameters,
        settings: FitSettings,
        work: Path | None,
    ) -> None:
        self.scene, self.views, self.parameters, self.settings = scene, views, parameters, settings
        self.fitted = [k for k, view in enumerate(views) if not view.held_out]
        self.weights = [_weights(view, settings.loss) for view in views]
        self.exposures, self.steps = np.ones(len(views)), []
        self.adam = mi.ad.Adam(lr=settings.rate)
        for name, x in parameters.start().items():
            self.adam[name] = x
        self.mean = {name: 0.0 for name in parameters.names}  # of the last steps
        self.kept = _KeptSteps(work / "state.npz", self._fingerprint()) if work else None

    def _fingerprint(self) -> str:
        start = {name: np.ravel(np.array(x)).tolist() for name, x in self.parameters.start().items()}
        of = json.dumps([asdict(self.settings), start, [(v.sensor, v.held_out) for v in self.views]])
        digest = hashlib.sha256(of.encode())
        for view in self.views:
            digest.update(view.image.tobytes() + view.counts.tobytes())
        return digest.hexdigest()

    # ---- steps

    def run(self, progress: ProgressText | None = None) -> None:
        """All steps that are left."""
        if self.kept is not None:
            self.kept.load(self)
        total = self.settings.steps
        while (k := len(self.steps)) < total:
            part = max(k / total - SETTLING, 0) / (1 - SETTLING)
            self.adam.set_learning_rate(self.settings.rate * LAST**part)
            self._step(k)
            if (last := k - int((1 - AVERAGED) * total)) >= 0:
                for name, mean in self.mean.items():
                    self.mean[name] = mean + (_numbers(self.adam[name]) - mean) / (last + 1)
            if self.kept is not None:
                self.kept.save(self)
            if progress:
                progress(k + 1, total, _line(self.steps[-1]))

    def _step(self, k: int) -> None:
        batch = min(self.settings.batch or 4, len(self.fitted))
        order = np.random.default_rng([self.settings.seed, k]).permutation(self.fitted)
        shown = self.parameters.shown(dict(self.adam))
        losses, variance = [], 0.0
        for which in order[:batch]:
            loss, noise, adjoint = self._compare(int(which), k)
            self.parameters.put(dict(self.adam))
            seed, spp = self._seed(k, int(which), "gradient"), self.settings.spp
            sensor = self.views[which].sensor
            self.scene.integrator().render_backward(self.scene, None, mi.TensorXf(adjoint / batch), sensor, seed, spp)
            losses.append(loss)
            variance += noise / batch**2
        self.adam.step()
        for name in self.parameters.names:
            self.adam[name] = self.parameters.clipped(name, dr.detach(self.adam[name]))
        values = {name: value.tolist() for name, value in shown.items()}
        self.steps.append(FitStep(float(np.mean(losses)), float(np.sqrt(variance)), values))

    def _compare(self, which: int, k: int) -> tuple[float, float, np.ndarray]:
        """Loss of a view, its variance by noise, and the gradient of the loss by the image."""
        view, w = self.views[which], self.weights[which]
        self._put()
        purposes = ("test", "other test") if view.held_out else ("first", "second")
        pair = [self._image(view, self._seed(k, which, each)) for each in purposes]
        if self.settings.exposure:
            self._expose(which, pair)
        e = self.exposures[which]
        a, b = (e * image - view.image for image in pair)
        n = max(float((w > 0).sum()), 1.0)
        noise = np.square(a - b) / 2  # variance of each
        variance = float((np.square(w) * (noise * (np.square(a) + np.square(b)) / 2)).sum()) / n**2
        return float((w * a * b).sum() / n), variance, (w * e * (a + b) / n).astype(np.float32)

    def _put(self) -> None:
        with dr.suspend_grad():
            self.parameters.put({name: dr.detach(x) for name, x in self.adam.items()})

    def _image(self, view: GivenView, seed: int) -> np.ndarray:
        image = mi.render(self.scene, sensor=view.sensor, seed=seed, spp=self.settings.spp)
        return np.array(image, dtype=np.float64)[..., : view.image.shape[2]]

    def _expose(self, which: int, pair: list[np.ndarray]) -> None:
        """The factor of least squares; those of all fitted views have the geometric mean 1."""
        counts, T = self.views[which].counts[..., None], self.views[which].image
        found = (counts * T * (pair[0] + pair[1]) / 2).sum() / max((counts * pair[0] * pair[1]).sum(), 1e-30)
        self.exposures[which] = np.clip(found, 1 / EXPOSURE, EXPOSURE)
        self.exposures[self.fitted] /= np.exp(np.log(self.exposures[self.fitted]).mean())

    def _seed(self, k: int, which: int, purpose: str) -> int:
        words = [self.settings.seed, k, which, PURPOSES.index(purpose)]
        return int(np.random.SeedSequence(words).generate_state(1)[0])

    # ---- the end

    def result(self) -> MaterialFit:
        """At the mean of the last steps."""
        for name in self.parameters.names:
            x = self.mean[name]
            self.adam[name] = type(self.adam[name])(x.tolist() if len(x) > 1 else float(x[0]))
        x, end = dict(self.adam), self.settings.steps
        losses = {which: self._compare(which, end)[0] for which in range(len(self.views))}
        fitted = float(np.mean([losses[which] for which in self.fitted]))
        held = [loss for which, loss in losses.items() if self.views[which].held_out]
        last = np.array([step.loss for step in self.steps[int((1 - AVERAGED) * end) :]])
        noise = float(last.std() / np.sqrt(len(last)))  # of its mean, which may be below 0
        covariance = self._covariance(max(float(last.mean()), noise))
        slopes = np.concatenate(list(self.parameters.slopes(x).values()))
        error = np.sqrt(np.maximum(np.diag(covariance), 0))
        correlation = covariance / np.maximum(np.outer(error, error), 1e-30)
        values, errors, at = self.parameters.shown(x), {}, 0
        for name, value in values.items():
            errors[name] = (error * slopes)[at : at + len(value)]
            at += len(value)
        self._put()
        told = self.parameters.at_bounds(x) + _ambiguity(values, correlation)
        medium, test = self.parameters.shape.bsdf().inside.medium, _root(float(np.mean(held))) if held else None
        exposures = self.exposures.tolist()
        return MaterialFit(values, errors, correlation, medium, _root(fitted), test, exposures, told, self.steps)

    def _covariance(self, loss: float) -> np.ndarray:
        """Of the variables: loss (J^T w J)^-1; the Jacobians of two independent renders stand in the product."""
        size = sum(len(_numbers(x)) for x in self.adam.values())
        normal, count = np.zeros((size, size)), 0
        for which in self.fitted:
            w = self.weights[which].ravel()
            pair = [self._jacobian(which, each) for each in ("slope", "other slope")]
            product = (pair[0] * w[:, None]).T @ pair[1]
            normal, count = normal + (product + product.T) / 2, count + int((w > 0).sum())
        e, v = np.linalg.eigh(normal)
        return loss * (v / np.maximum(e, 1e-9 * max(e.max(), 1e-30))) @ v.T

    def _jacobian(self, which: int, purpose: str) -> np.ndarray:
        """Derivatives of all pixels by all variables; a channel knows of no other but by g."""
        view, columns = self.views[which], []
        for j, name in enumerate(self.parameters.names):
            x = {key: type(value)(dr.detach(value)) for key, value in self.adam.items()}
            dr.enable_grad(x[name])
            dr.set_grad(x[name], 1.0)
            self.parameters.put(x)
            seed = self._seed(self.settings.steps + j, which, purpose)
            spp = self.settings.spp
            found = self.scene.integrator().render_forward(self.scene, None, view.sensor, seed, spp)
            d = self.exposures[which] * np.array(found, dtype=np.float64)[..., : view.image.shape[2]]
            numbers = len(_numbers(x[name]))
            for c in range(numbers):
                keep = np.ones(d.shape[2]) if numbers == 1 else np.arange(d.shape[2]) == c
                columns.append((d * keep).ravel())
        return np.stack(columns, axis=1)


class _KeptSteps:
    """The state of a descent after each step, in a file."""

    def __init__(self, path: Path, of: str) -> None:
        self.path, self.of = path, of

    def save(self, descent: MediumDescent) -> None:
        arrays = {"exposures": descent.exposures, "of": np.array(self.of), "steps": np.array(json.dumps(descent.steps))}
        for name in descent.parameters.names:
            x, _, _, (t, m, v, *_) = descent.adam.state[name]
            for key, value in (("x", x), ("t", t), ("m", m), ("v", v)):
                arrays[f"{name} {key}"] = np.array(dr.detach(value))
            arrays[f"{name} mean"] = np.asarray(descent.mean[name])
        file = io.BytesIO()
        np.savez(file, **arrays)
        write_atomically(self.path, file.getvalue())

    def load(self, descent: MediumDescent) -> None:
        """Go on where a fit was left; ValueError if that was another one."""
        if not self.path.exists():
            return
        try:
            arrays = dict(np.load(self.path, allow_pickle=False))
        except (OSError, ValueError, EOFError) as error:
            raise ValueError(f"{self.path} must be the state of a fit, got {error}") from error
        if str(arrays["of"]) != self.of:
            raise ValueError(
                f"work must be a new folder or that of the same fit, got another one in {self.path.parent}"
            )
        descent.exposures = arrays["exposures"]
        descent.steps = [FitStep(*row) for row in json.loads(str(arrays["steps"]))]
        for name in descent.parameters.names:
            x, *rest, (t, m, v, *more) = descent.adam.state[name]
            now = [_like(old, arrays[f"{name} {key}"]) for key, old in (("x", x), ("t", t), ("m", m), ("v", v))]
            dr.enable_grad(now[0])
            descent.adam.state[name] = (now[0], *rest, (*now[1:], *more))
            descent.mean[name] = arrays[f"{name} mean"]


def _like(old: mi.Float | mi.Spectrum, values: np.ndarray) -> mi.Float | mi.Spectrum:
    """Numbers as an array of another's kind, which may be None in a new optimizer."""
    numbers = np.ravel(values).tolist()
    if old is None:
        return mi.Spectrum(numbers) if len(numbers) > 1 else mi.Float(numbers)
    return type(old)(numbers if len(numbers) > 1 else numbers[0])


def _numbers(x: mi.Float | mi.Spectrum) -> np.ndarray:
    return np.ravel(np.array(dr.detach(x), dtype=float))


def _weights(view: GivenView, loss: str) -> np.ndarray:
    """Of each pixel and channel; 0 where it does not count."""
    w = np.ones(view.image.shape) if loss == "l2" else None
    if w is None:
        T = np.maximum(view.image, 0)
        w = 1 / np.square(T + FLOOR * max(float(T[view.counts].mean()) if view.counts.any() else 0.0, 1e-6))
    return np.where(view.counts[..., None], w, 0.0)


def _root(loss: float) -> float:
    return float(np.sqrt(max(loss, 0.0)))


def _line(step: FitStep) -> str:
    numbers = "; ".join(f"{name} {' '.join(f'{v:.4g}' for v in value)}" for name, value in step.values.items())
    return f"loss {step.loss:.3g} ± {step.error:.1g}  {numbers}"


def _ambiguity(values: dict[str, np.ndarray], correlation: np.ndarray) -> list[str]:
    """What images cannot tell apart: sigma_t and g, beyond sigma_t (1 - g)."""
    extent = next((name for name in ("sigma_t", "mfp") if name in values), None)
    if extent is None or "g" not in values:
        return []
    places, at = {}, 0
    for name, value in values.items():
        places[name], at = range(at, at + len(value)), at + len(value)
    found = [correlation[i, places["g"][0]] for i in places[extent]]
    told = " ".join(f"{c:.3f}" for c in found)
    return [f"correlation of log {extent} and g: {told}; near 1 in size, images tell sigma_t (1 - g) only"]
