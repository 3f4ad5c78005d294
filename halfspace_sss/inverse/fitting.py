"""The fit: damped Gauss-Newton steps on images of a scene, by unbiased slopes and an unbiased loss.

With two renders I, I' of independent samples, an image T and weights w, the loss of a view is

    mean w (I - T) (I' - T),    half its gradient g = mean w J^T ((I + I') / 2 - T),    H = mean w J^T J',

where the Jacobians J, J' of pixels by variables have samples of their own, so that noise has no bias in any of them
(Deng et al. 2022 take the product of two renders too). H is a running mean over steps. The variables move by -H^-1 g,
in the second half of the steps by 1, 1/2, 1/3, ... of that, which averages the noise of g (Robbins and Monro 1951).
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

from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.inverse.parameters import FitParameters, translucent_object
from halfspace_sss.inverse.views import GivenView, check_views
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import ProgressText
from halfspace_sss.provenance import check_folder, write_atomically
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, open_scene

LOSSES = ("relative", "l2")
FLOOR = 0.1  # of the mean of an image, added to it in relative weights
SETTLING = 0.5  # part of the steps after which they are averaged
MEMORY = 0.15  # of H, what a step is at least
LONGEST = 0.7  # change of a variable in a step
DAMPED = 1e-3  # of the largest eigenvalue of H, below which it is not trusted
EXPOSURE = 10.0  # most, of a factor
WALK = "translucent_walk"
PURPOSES = ("order", "first", "second", "slope", "other slope", "test", "other test")


@dataclass(frozen=True)
class FitSettings:
    """How to fit.

    Args:
        steps: how many.
        spp: samples a pixel of each render of a view: two images, and its slopes by each parameter.
        batch: views a step; 0 takes 4 or all, whichever is less.
        loss: "relative" or "l2".
        exposure: whether each image may have a factor of its own, of geometric mean 1.
        seed: of all samples.
    """

    steps: int = 30
    spp: int = 64
    batch: int = 0
    loss: str = "relative"
    exposure: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("spp", 1), ("batch", 0), ("seed", 0)):
            check_count(name, getattr(self, name), least)
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
        errors: standard errors by H, the misfit, and the noise of the steps.
        correlation: of all numbers in the order of `values`.
        medium: of the object.
        misfit: root of the loss of all fitted views at the end.
        held_out: likewise of views held out; None without any.
        exposures: factor by which each view's image of the medium is multiplied to match the given one.
        told: sentences about bounds and about what the images do not tell.
        steps: the way there.
    """

    values: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    correlation: np.ndarray
    medium: Medium
    misfit: NoiseFree
    held_out: NoiseFree | None
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
    """Gauss-Newton steps on the variables of a medium.

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
        self.x = parameters.start()
        size = sum(len(_numbers(x)) for x in self.x.values())
        self.H, self.slopes = np.zeros((size, size)), {}  # slopes: the last Jacobian of each view
        self.moves = np.zeros((0, size))  # -H^-1 g of the steps that are averaged
        self.kept = _KeptSteps(work / "state.npz", self._fingerprint()) if work else None

    def _fingerprint(self) -> str:
        start = {name: _numbers(x).tolist() for name, x in self.parameters.start().items()}
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
        while (k := len(self.steps)) < self.settings.steps:
            self._step(k)
            if self.kept is not None:
                self.kept.save(self)
            if progress:
                progress(k + 1, self.settings.steps, _line(self.steps[-1]))

    def _step(self, k: int) -> None:
        batch = min(self.settings.batch or 4, len(self.fitted))
        order = np.random.default_rng([self.settings.seed, k]).permutation(self.fitted)[:batch]
        values = {name: value.tolist() for name, value in self.parameters.shown(self.x).items()}
        losses, variance, g, H = [], 0.0, 0.0, 0.0
        for which in map(int, order):
            loss, noise, residual = self._compare(which, k)
            J = self._jacobian(which, k, "slope")
            before = self.slopes.get(which)
            w = self.weights[which].ravel() / self._count(which)
            product = (J * w[:, None]).T @ (self._jacobian(which, k, "other slope") if before is None else before)
            g, H = g + J.T @ (w * residual.ravel()) / batch, H + (product + product.T) / (2 * batch)
            self.slopes[which] = J
            losses.append(loss)
            variance += noise / batch**2
        self.H += max(MEMORY, 1 / (k + 1)) * (H - self.H)
        move = -_solved(self.H, g)
        move *= min(1.0, LONGEST / max(np.abs(move).max(), 1e-30))
        later = k - int(SETTLING * self.settings.steps)
        if later >= 0:
            self.moves = np.vstack([self.moves, move])
        self._move(move / max(later + 1, 1))
        self.steps.append(FitStep(float(np.mean(losses)), float(np.sqrt(variance)), values))

    def _move(self, move: np.ndarray) -> None:
        at = 0
        for name, x in self.x.items():
            now = _numbers(x) + move[at : at + len(_numbers(x))]
            at += len(now)
            self.x[name] = self.parameters.clipped(name, type(x)(now.tolist() if len(now) > 1 else float(now[0])))

    def _count(self, which: int) -> float:
        """Numbers of a view that count."""
        return max(float((self.weights[which] > 0).sum()), 1.0)

    def _compare(self, which: int, k: int) -> tuple[float, float, np.ndarray]:
        """Loss of a view, its variance by noise, and the mean residual of both renders."""
        view, w = self.views[which], self.weights[which]
        self.parameters.put(self.x)
        purposes = ("test", "other test") if view.held_out else ("first", "second")
        pair = [self._image(view, self._seed(k, which, each)) for each in purposes]
        if self.settings.exposure:
            self._expose(which, pair)
        e = self.exposures[which]
        a, b = (e * image - view.image for image in pair)
        n = self._count(which)
        noise = np.square(a - b) / 2  # variance of each
        variance = float((np.square(w) * (noise * (np.square(a) + np.square(b)) / 2)).sum()) / n**2
        return float((w * a * b).sum() / n), variance, (a + b) / 2

    def _image(self, view: GivenView, seed: int) -> np.ndarray:
        image = mi.render(self.scene, sensor=view.sensor, seed=seed, spp=self.settings.spp)
        return np.array(image, dtype=np.float64)[..., : view.image.shape[2]]

    def _expose(self, which: int, pair: list[np.ndarray]) -> None:
        """The factor of least squares; those of all fitted views have the geometric mean 1."""
        counts, T = self.views[which].counts[..., None], self.views[which].image
        found = (counts * T * (pair[0] + pair[1]) / 2).sum() / max((counts * pair[0] * pair[1]).sum(), 1e-30)
        self.exposures[which] = np.clip(found, 1 / EXPOSURE, EXPOSURE)
        self.exposures[self.fitted] /= np.exp(np.log(self.exposures[self.fitted]).mean())

    def _seed(self, k: int, which: int, purpose: str, parameter: int = 0) -> int:
        words = [self.settings.seed, k, which, PURPOSES.index(purpose), parameter]
        return int(np.random.SeedSequence(words).generate_state(1)[0])

    # ---- the end

    def result(self) -> MaterialFit:
        """Where the steps have ended."""
        x, end = self.x, self.settings.steps
        losses = [self._compare(which, end)[:2] for which in range(len(self.views))]
        fitted = _root([losses[which] for which in self.fitted])
        held = [loss for loss, view in zip(losses, self.views) if view.held_out]
        last = np.array([step.loss for step in self.steps[int(SETTLING * end) :]])
        noise = float(last.std() / np.sqrt(len(last)))  # of its mean, which may be below 0
        covariance = self._covariance(max(float(last.mean()), noise))
        slopes = np.concatenate(list(self.parameters.slopes(x).values()))
        error = np.sqrt(np.maximum(np.diag(covariance), 0))
        correlation = covariance / np.maximum(np.outer(error, error), 1e-30)
        values, errors, at = self.parameters.shown(x), {}, 0
        for name, value in values.items():
            errors[name] = (error * slopes)[at : at + len(value)]
            at += len(value)
        self.parameters.put(x)
        told = self.parameters.at_bounds(x) + _ambiguity(values, correlation)
        medium, test = self.parameters.shape.bsdf().inside.medium, _root(held) if held else None
        exposures = self.exposures.tolist()
        return MaterialFit(values, errors, correlation, medium, fitted, test, exposures, told, self.steps)

    def _covariance(self, loss: float) -> np.ndarray:
        """Of the variables: loss H^-1 / n by the images, and the noise of the mean of the last steps."""
        n = sum(self._count(which) for which in self.fitted)
        by_images = loss * _solved(self.H, np.eye(len(self.H))) / n
        m = len(self.moves)
        return by_images + (np.atleast_2d(np.cov(self.moves.T)) / m if m > 1 else 0.0)

    def _jacobian(self, which: int, k: int, purpose: str) -> np.ndarray:
        """Derivatives of all pixels by all variables; a channel knows of no other but by g."""
        view, columns = self.views[which], []
        for j, name in enumerate(self.parameters.names):
            x = {key: type(value)(value) for key, value in self.x.items()}
            dr.enable_grad(x[name])
            dr.set_grad(x[name], 1.0)
            self.parameters.put(x)
            seed = self._seed(k, which, purpose, j)
            spp = self.settings.spp
            found = self.scene.integrator().render_forward(self.scene, None, view.sensor, seed, spp)
            d = self.exposures[which] * np.array(found, dtype=np.float64)[..., : view.image.shape[2]]
            numbers = len(_numbers(x[name]))
            for c in range(numbers):
                keep = np.ones(d.shape[2]) if numbers == 1 else np.arange(d.shape[2]) == c
                columns.append((d * keep).ravel())
        return np.stack(columns, axis=1)


def _solved(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    """H^-1 g; noise makes small eigenvalues of H wrong, negative ones too."""
    e, v = np.linalg.eigh(H)
    e = np.maximum(np.abs(e), DAMPED * max(np.abs(e).max(), 1e-30))
    return (v / e) @ (v.T @ g)


class _KeptSteps:
    """The state of a descent after each step, in a file."""

    def __init__(self, path: Path, of: str) -> None:
        self.path, self.of = path, of

    def save(self, descent: MediumDescent) -> None:
        arrays = {"exposures": descent.exposures, "of": np.array(self.of), "steps": np.array(json.dumps(descent.steps))}
        arrays |= {"H": descent.H, "moves": descent.moves}
        arrays |= {f"slopes {which}": J for which, J in descent.slopes.items()}
        arrays |= {f"x {name}": _numbers(x) for name, x in descent.x.items()}
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
        descent.exposures, descent.H, descent.moves = (arrays[key] for key in ("exposures", "H", "moves"))
        descent.steps = [FitStep(*row) for row in json.loads(str(arrays["steps"]))]
        descent.slopes = {int(key.split()[1]): J for key, J in arrays.items() if key.startswith("slopes ")}
        for name, x in descent.x.items():
            numbers = arrays[f"x {name}"].tolist()
            descent.x[name] = type(x)(numbers if len(numbers) > 1 else numbers[0])


def _numbers(x: mi.Float | mi.Spectrum) -> np.ndarray:
    return np.ravel(np.array(dr.detach(x), dtype=float))


def _weights(view: GivenView, loss: str) -> np.ndarray:
    """Of each pixel and channel; 0 where it does not count."""
    w = np.ones(view.image.shape) if loss == "l2" else None
    if w is None:
        T = np.maximum(view.image, 0)
        w = 1 / np.square(T + FLOOR * max(float(T[view.counts].mean()) if view.counts.any() else 0.0, 1e-6))
    return np.where(view.counts[..., None], w, 0.0)


def _root(losses: Sequence[tuple[float, float]]) -> NoiseFree:
    """The root of a mean loss, of losses and their variances."""
    loss, variance = np.mean(losses, axis=0)
    return NoiseFree(float(loss), float(np.sqrt(variance / len(losses))))


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
