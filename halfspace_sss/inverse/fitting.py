"""The fit of a homogeneous medium: damped Gauss-Newton steps on images of a scene, by unbiased slopes and loss.

Half the gradient of the loss of a view, see `comparing`, and H of the steps are

    g = mean w J^T ((I + I') / 2 - T),    H = mean w J^T J',

where the Jacobians J, J' of pixels by variables have samples of their own, so that noise has no bias in any of them.
J is a running mean over the steps of a view, and H over all steps. Exposures of views are variables too, by their
logarithms, whose sum is 0: the derivatives of pixels by them are the image. The variables move by -H^-1 g, in the
second half of the steps by 1, 1/2, 1/3, ... of that, which averages the noise of g (Robbins and Monro 1951). Textures
are fitted by `textures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.inverse.comparing import FitSettings, FitStep, MaterialFit, ViewComparison, ViewMisfit, descend
from halfspace_sss.inverse.parameters import FitParameters, check_derivatives, translucent_object
from halfspace_sss.inverse.views import GivenView, check_views
from halfspace_sss.progress import ProgressText
from halfspace_sss.provenance import check_folder
from halfspace_sss.rendering.object.wrapped import surface_of
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, open_scene

STEPS = 30
SETTLING = 0.5  # part of the steps after which they are averaged
MEMORY = 0.15  # of J and H, what a step is at least
LONGEST = 0.7  # change of a variable in a step
DAMPED = 1e-3  # of the largest eigenvalue of H, below which it is not trusted
WALK = "translucent_walk"


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
        parameters: names of `parameters.NAMES`; where the medium has a texture for one, the texture is fitted, a
            bitmap or an attribute of the mesh.
        model: `translucent_walk` or the name of a model of the half-space; None, and a Mitsuba scene, keep the
            integrator.
        object: name of the object; without it there must be one only.
        settings: how.
        work: a folder where each step is kept; the same fit started again goes on there, with the same bits.
        progress: called after each step.

    Raises:
        ValueError: an argument is out of range, views do not belong to the scene, none shows the object, images by
            the model have no derivatives, or `work` is that of another fit.
    """
    settings = settings or FitSettings()
    if not isinstance(scene, mi.Scene):
        scene = open_scene(scene, PATH_TRACED if model == WALK else model)
    shape = translucent_object(scene, object)
    check_derivatives(scene.integrator(), shape, parameters)
    mm_per_unit = scene.integrator().mm_per_unit
    check_views(scene, images, shape)
    work = None if work is None else check_folder(work)
    comparison, textured = ViewComparison(scene, list(images), settings), surface_of(shape).inside.textured is not None
    if textured:
        from halfspace_sss.inverse.textures import TextureDescent, TextureParameters  # torch

        descent = TextureDescent(comparison, TextureParameters.of(parameters, shape, mm_per_unit, scene))
    else:
        descent = MediumDescent(comparison, FitParameters.of(parameters, shape, mm_per_unit))
    descend(descent, work, progress)
    return descent.result()


class MediumDescent:
    """Gauss-Newton steps on the variables of a medium.

    Args:
        comparison: of the scene with images.
        parameters: what is fitted.
    """

    def __init__(self, comparison: ViewComparison, parameters: FitParameters) -> None:
        self.comparison, self.parameters = comparison, parameters
        self.total = comparison.settings.steps or STEPS
        self.steps: list[FitStep] = []
        self.x = parameters.start()
        n = len(comparison.fitted) if comparison.settings.exposure else 1
        self.free = _of_sum_0(n)  # directions of log exposures, shape (views, views - 1)
        size = sum(len(_numbers(x)) for x in self.x.values()) + n - 1
        self.H, self.slopes, self.visits = np.zeros((size, size)), {}, {}  # slopes: the mean Jacobian of each view
        self.moves = np.zeros((0, size))  # -H^-1 g of the steps that are averaged

    def fingerprint(self) -> str:
        return self.comparison.fingerprint({name: _numbers(x).tolist() for name, x in self.parameters.start().items()})

    def state(self) -> dict[str, np.ndarray]:
        slopes = {f"slopes {which}": J for which, J in self.slopes.items()}
        x = {f"x {name}": _numbers(x) for name, x in self.x.items()}
        visits = np.array(list(self.visits.items()))
        return {"H": self.H, "moves": self.moves, "visits": visits, **slopes, **x}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.H, self.moves = arrays["H"], arrays["moves"]
        self.visits = dict(arrays["visits"].tolist())
        self.slopes = {int(key.split()[1]): J for key, J in arrays.items() if key.startswith("slopes ")}
        for name, x in self.x.items():
            numbers = arrays[f"x {name}"].tolist()
            self.x[name] = self.parameters.clipped(name, type(x)(numbers if len(numbers) > 1 else numbers[0]))

    # ---- steps

    def step(self, k: int) -> FitStep:
        compared = self.comparison
        values = {name: value.tolist() for name, value in self.parameters.shown(self.x).items()}
        losses, variance, g, H = [], 0.0, 0.0, 0.0
        for which in (views := compared.batch(k)):
            self.parameters.put(self.x)
            misfit = compared.view(which, k)
            new = self._jacobian(which, k, "slope")
            before = self.slopes.get(which)
            if before is None:
                before = self._jacobian(which, k, "other slope")
            self.visits[which] = self.visits.get(which, 0) + 1
            J = before + max(MEMORY, 1 / (self.visits[which] + 1)) * (new - before)
            gv, Hv = self._normal(which, misfit, J, before, new)
            g, H = g + gv / len(views), H + Hv / len(views)
            self.slopes[which] = J
            losses.append(misfit.loss)
            variance += misfit.variance / len(views) ** 2
        self.H += max(MEMORY, 1 / (k + 1)) * (H - self.H)
        move = -_solved(self.H, g)
        move *= min(1.0, LONGEST / max(np.abs(move).max(), 1e-30))
        later = k - int(SETTLING * self.total)
        if later >= 0:
            self.moves = np.vstack([self.moves, move])
        self._move(move / max(later + 1, 1))
        return FitStep(float(np.mean(losses)), float(np.sqrt(variance)), values)

    def _normal(
        self, which: int, misfit: ViewMisfit, J: np.ndarray, before: np.ndarray, new: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """g and H of a view, by J and by two Jacobians of independent samples; without the exposure e in any."""
        compared, e = self.comparison, self.comparison.exposures[which]
        w = misfit.weights.ravel() / compared.count(which)
        g, H = e * J.T @ (w * misfit.residual.ravel()), e**2 * (before * w[:, None]).T @ new
        if self.free.size:
            direction = self.free[compared.fitted.index(which)]
            image = (misfit.residual + compared.views[which].image).ravel()
            cross = e * np.outer(J.T @ (w * image), direction)
            H = np.block([[H, cross], [cross.T, misfit.exposure_curvature * np.outer(direction, direction)]])
            g = np.append(g, misfit.exposure_slope * direction)
        return g, (H + H.T) / 2

    def _move(self, move: np.ndarray) -> None:
        at = 0
        for name, x in self.x.items():
            now = _numbers(x) + move[at : at + len(_numbers(x))]
            at += len(now)
            self.x[name] = self.parameters.clipped(name, type(x)(now.tolist() if len(now) > 1 else float(now[0])))
        for which, share in zip(self.comparison.fitted, self.free @ move[at:]):
            self.comparison.expose(which, np.expm1(share))

    # ---- the end

    def result(self) -> MaterialFit:
        """Where the steps have ended."""
        x, end = self.x, self.total
        self.parameters.put(x)
        fitted, test, views = self.comparison.ends(end)
        last = np.array([step.loss for step in self.steps[int(SETTLING * end) :]])
        noise = float(last.std() / np.sqrt(len(last)))  # of its mean, which may be below 0
        covariance = self._covariance(max(float(last.mean()), noise))
        slopes = np.concatenate(list(self.parameters.slopes(x).values()))
        covariance = covariance[: len(slopes), : len(slopes)]  # without exposures
        error = np.sqrt(np.maximum(np.diag(covariance), 0))
        correlation = covariance / np.maximum(np.outer(error, error), 1e-30)
        values, errors, at = self.parameters.shown(x), {}, 0
        for name, value in values.items():
            errors[name] = (error * slopes)[at : at + len(value)]
            at += len(value)
        told = self.parameters.at_bounds(x) + _ambiguity(values, correlation)
        medium, exposures = surface_of(self.parameters.shape).inside.medium, self.comparison.exposures.tolist()
        return MaterialFit(values, errors, correlation, medium, fitted, test, exposures, told, self.steps, views)

    def _covariance(self, loss: float) -> np.ndarray:
        """Of the variables: loss H^-1 / n by the images, and the noise of the mean of the last steps."""
        n = sum(self.comparison.count(which) for which in self.comparison.fitted)
        by_images = loss * _solved(self.H, np.eye(len(self.H))) / n
        m = len(self.moves)
        return by_images + (np.atleast_2d(np.cov(self.moves.T)) / m if m > 1 else 0.0)

    def _jacobian(self, which: int, k: int, purpose: str) -> np.ndarray:
        """Derivatives of all pixels by all variables; a channel knows of no other but by g."""
        compared, columns = self.comparison, []
        view, spp = compared.views[which], compared.settings.spp
        for j, name in enumerate(self.parameters.names):
            x = {key: type(value)(value) for key, value in self.x.items()}
            dr.enable_grad(x[name])
            dr.set_grad(x[name], 1.0)
            self.parameters.put(x)
            dr.forward_from(x[name], dr.ADFlag.ClearEdges)  # models begin at the coefficients
            seed, scene = compared.seed(k, which, purpose, j), compared.scene
            found = scene.integrator().render_forward(scene, None, view.sensor, seed, spp)
            d = np.array(found, dtype=np.float64)[..., : view.image.shape[2]]
            numbers = len(_numbers(x[name]))
            for c in range(numbers):
                keep = np.ones(d.shape[2]) if numbers == 1 else np.arange(d.shape[2]) == c
                columns.append((d * keep).ravel())
        return np.stack(columns, axis=1)


def _solved(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    """H^-1 g; noise makes small eigenvalues of H wrong, negative ones too."""
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-30))
    e, v = np.linalg.eigh(H * np.outer(scale, scale))
    e = np.maximum(np.abs(e), DAMPED * max(np.abs(e).max(), 1e-30))
    return np.diag(scale) @ (v / e) @ (v.T @ (np.diag(scale) @ g))


def _of_sum_0(n: int) -> np.ndarray:
    """An orthonormal basis of vectors of n numbers whose sum is 0, shape (n, n - 1)."""
    return np.linalg.svd(np.ones((1, n)))[2][1:].T


def _numbers(x: mi.Float | mi.Spectrum) -> np.ndarray:
    return np.ravel(np.array(dr.detach(x), dtype=float))


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
