"""The fit of a homogeneous medium: damped Gauss-Newton steps on images of a scene, by unbiased slopes and loss.

A view keeps the means of what was measured of it: of its render I, of the variables x there, and of the Jacobian J of
pixels by variables. With weights w and a target T, half the gradient of its loss at x, and H, are

    g = mean w J^T (I - T) + H (x - mean of x),    H = w (mean J)^T (mean J),

the product in g over different renders, so that noise, whose samples are independent, has no bias in it. H has that of
the noise of J: it is never negative, and steps are short where J is not known yet. The variables move by -H^-1 g of all
views. In the first part of the steps a view forgets what was measured far from where the variables are now; later it
forgets nothing, and the noise of all its samples is averaged. Exposures of views are variables too, by their
logarithms, whose sum is 0: the derivatives of pixels by them are the image. Textures are fitted by `textures`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.linalg import null_space

from full_geometry.inverse.comparing import (
    CERTAIN,
    LONGEST,
    SETTLING,
    ChiSquare,
    FitSettings,
    FitStep,
    MaterialFit,
    ViewComparison,
    ViewMisfit,
    arrays_of_means,
    kept_at,
    means_of_arrays,
)
from full_geometry.inverse.parameters import FitParameters, check_derivatives, translucent_object
from full_geometry.inverse.textures import TextureDescent, variables_of
from full_geometry.inverse.views import GivenView, check_views
from full_geometry.scenes.scene_files import PATH_TRACED, open_scene
from full_geometry.settings import check_variant
from full_geometry.surface.wrapped import surface_of
from halfspace_sss.progress import ProgressText
from halfspace_sss.provenance import check_folder, write_atomically

STEPS = 30
STEP = 0.15  # of variables, for differences
DAMPED = 1e-3  # of the largest eigenvalue of H, below which it is not trusted
WALK = "translucent_walk"


def fit(
    scene: mi.Scene | dict[str, Any] | str | Path,
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
        model: `translucent_walk`, `neural_shape` or a model of the half-space; None, and a Mitsuba scene, keep the
            integrator.
        object: name of the object; without it there must be one only.
        settings: how.
        work: a folder where each step is kept; the same fit started again goes on there, with the same bits.
        progress: called after each step.

    Raises:
        ValueError: an argument is out of range, views do not belong to the scene, none shows the object, images by
            the model have no derivatives, or `work` is that of another fit.
    """
    check_variant()
    settings = settings or FitSettings()
    if not isinstance(scene, mi.Scene):
        walks = {"light": settings.light} if model == WALK else {}  # as derivatives are, with the same bits in each run
        scene = open_scene(scene, PATH_TRACED if model == WALK else model, settings=walks, floats=True)
    shape = translucent_object(scene, object)
    check_derivatives(scene.integrator(), shape, parameters)
    mm_per_unit = scene.integrator().mm_per_unit
    check_views(scene, images, shape)
    work = None if work is None else check_folder(work)
    comparison, textured = ViewComparison(scene, list(images), settings), surface_of(shape).spec.textured is not None
    if textured:
        descent = TextureDescent(comparison, shape, variables_of(parameters, shape, mm_per_unit, scene))
    else:
        descent = MediumDescent(comparison, FitParameters(parameters, shape, mm_per_unit))
    descend(descent, work, progress)
    return descent.result()


def descend(descent: MediumDescent | TextureDescent, work: Path | None, progress: ProgressText | None) -> None:
    """Take all steps that are left, kept in the folder `work`, from which the same fit goes on.
    ValueError if `work` is that of another fit."""
    path, of = work and work / "state.npz", descent.fingerprint()
    if path is not None and path.exists():
        _load(path, of, descent)
    while (k := len(descent.steps)) < descent.total:
        descent.steps.append(descent.step(k))
        if path is not None:
            _save(path, of, descent)
        if progress:
            progress(k + 1, descent.total, descent.steps[-1].line())


def _save(path: Path, of: str, descent: MediumDescent | TextureDescent) -> None:
    arrays = {"of": np.array(of), "steps": np.array(json.dumps(descent.steps))}
    file = io.BytesIO()
    shown = {f"shown {which}": image for which, image in descent.comparison.shown.items()}
    np.savez(file, **arrays, factors=descent.comparison.factors, **shown, **descent.state())
    write_atomically(path, file.getvalue())


def _load(path: Path, of: str, descent: MediumDescent | TextureDescent) -> None:
    try:
        arrays = dict(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path} must be the state of a fit, got {error}") from error
    if str(arrays["of"]) != of:
        raise ValueError(f"work must be a new folder or come from the same fit, got another one in {path.parent}")
    descent.comparison.factors[:] = arrays.pop("factors")
    for key in [key for key in arrays if key.startswith("shown ")]:
        descent.comparison.shown[int(key.split()[1])] = arrays.pop(key)
    descent.steps = [FitStep(*row) for row in json.loads(str(arrays["steps"]))]
    descent.restore(arrays)


class ViewMeans:
    """Means of what was measured of a view in the steps, nothing at first.

    Attributes:
        weights, stiffness, image, variance: of all pixels; renders without exposure times weights, and variance of that
            mean by noise.
        x: the variables there.
        renders: how many the means count for.
        J: mean Jacobian, (pixels, variables), of as many as `jacobians` counts for.
        own: sum of products of weights times w J^T I and w J^T T, of Jacobian J and image I of the same render.
        own_share: sum of products of the weights of both.
    """

    def __init__(self, pixels: int, variables: int) -> None:
        self.weights = self.stiffness = self.image = self.variance = np.zeros(pixels)
        self.x, self.J, self.own = np.zeros(variables), np.zeros((pixels, variables)), np.zeros((2, variables))
        self.renders = self.jacobians = self.own_share = 0.0

    def forget(self, x: np.ndarray) -> None:
        """Count less for what is far from x."""
        kept = float(kept_at(np.abs(x - self.x).max()))
        self.renders, self.jacobians = kept * self.renders, kept * self.jacobians

    def add(
        self, w: np.ndarray, stiffness: np.ndarray, image: np.ndarray, J: np.ndarray | None, T: np.ndarray,
        noise: np.ndarray, x: np.ndarray,
    ) -> None:  # fmt: skip
        """A render more, at x: its image and Jacobian (None: without one), and the variance of the image by noise."""
        self.renders += 1
        b = 1 / self.renders
        self.weights = self.weights + b * (w - self.weights)
        self.stiffness = self.stiffness + b * (stiffness - self.stiffness)
        self.image = self.image + b * (w * image - self.image)
        self.variance = (1 - b) ** 2 * self.variance + b**2 * w**2 * noise
        self.x = self.x + b * (x - self.x)
        self.own, self.own_share = (1 - b) * self.own, (1 - b) * self.own_share
        if J is None:
            return
        self.jacobians += 1
        a = 1 / self.jacobians
        self.J = self.J + a * (J - self.J)
        self.own = (1 - a) * self.own + a * b * np.stack([w * image, w * T]) @ J
        self.own_share = (1 - a) * self.own_share + a * b

    def curvature(self) -> np.ndarray:
        """w J^T J of the mean."""
        return (self.J * self.weights[:, None]).T @ self.J

    def product(self) -> float:
        """w I I' of different renders."""
        return float(((self.image**2 - self.variance) / np.maximum(self.weights, 1e-30)).sum())

    def by(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """w J^T I' and w J^T T' of different renders; of the same ones, noise of J meets I - T only."""
        both = np.stack([self.image, self.weights * T]) @ self.J
        return tuple((both - self.own) / (1 - self.own_share))


class MediumDescent:
    """Gauss-Newton steps on the variables of a medium.
    `comparison`: of the scene with images."""

    def __init__(self, comparison: ViewComparison, parameters: FitParameters) -> None:
        self.comparison, self.parameters = comparison, parameters
        self.total = comparison.settings.steps or STEPS
        self.steps: list[FitStep] = []
        self.x = parameters.start()
        n = len(comparison.fitted) if comparison.settings.exposure else 1
        self.free = null_space(np.ones((1, n)))  # directions of log exposures of sum 0, shape (views, views - 1)
        self.means: dict[int, ViewMeans] = {}

    def fingerprint(self) -> str:
        return self.comparison.fingerprint({name: _numbers(x).tolist() for name, x in self.parameters.start().items()})

    def state(self) -> dict[str, np.ndarray]:
        """All that the next step depends on, but exposures and steps."""
        return {**arrays_of_means(self.means), **{f"x {name}": _numbers(x) for name, x in self.x.items()}}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.means = means_of_arrays(arrays, ViewMeans)
        for name, x in self.x.items():
            numbers = arrays[f"x {name}"].tolist()
            self.x[name] = self.parameters.clipped(name, type(x)(numbers if len(numbers) > 1 else numbers[0]))

    # ---- steps

    def step(self, k: int) -> FitStep:
        compared, x = self.comparison, np.concatenate([_numbers(each) for each in self.x.values()])
        values = {name: value.tolist() for name, value in self.parameters.shown(self.x).items()}
        losses, variance = [], 0.0
        for which in (views := compared.batch(k)):
            misfit = self._measure(which, k, x)
            losses.append(misfit.loss)
            variance += misfit.variance / len(views) ** 2
        g, H = self._normal(x)
        move = -_solved(H, g)
        self._move(move * min(1.0, LONGEST / max(np.abs(move).max(), 1e-30)))
        return FitStep(float(np.mean(losses)), float(np.sqrt(variance)), values)

    def _measure(self, which: int, k: int, x: np.ndarray) -> ViewMisfit:
        """Render a view twice, and add that to its means."""
        compared, view = self.comparison, self.comparison.views[which]
        means = self.means.setdefault(which, ViewMeans(view.image.size, len(x)))
        if k < SETTLING * self.total:
            means.forget(x)
        one, both = compared.sloping(means.jacobians, self.x)
        (a, J), (b, other_J) = self._render(which, k, "first", one), self._render(which, k, "second", both)
        misfit = compared.view(which, k, [a, b])
        w, stiffness = (v.ravel() / compared.count(which) for v in (misfit.weights, misfit.stiffness))
        noise = 2 * misfit.noise.ravel() / compared.exposures[which] ** 2
        for image, slopes in ((a, J), (b, other_J)):
            means.add(w, stiffness, image.ravel(), slopes, view.image.ravel(), noise, x)
        return misfit

    def _directions(self, which: int, common: bool = False) -> np.ndarray:
        """Derivatives of the log exposure of a view by the variables of exposures; at last by one of all views."""
        own = self.free[self.comparison.fitted.index(which)] if self.free.size else np.zeros(0)
        return np.append(own, 1.0) if common else own

    def _normal(self, x: np.ndarray, common: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """g and H of all variables, those of exposures last, at x: means of the views that were met."""
        n, size = len(x), len(x) + self.free.shape[1] + common
        g, H = np.zeros(size), np.zeros((size, size))
        for which, means in self.means.items():
            compared, e, moved = self.comparison, self.comparison.exposures[which], x - means.x
            T, curved = compared.views[which].image.ravel(), means.curvature()
            by, by_T = means.by(T)
            g[:n] += e**2 * (by + curved @ moved) - e * by_T
            H[:n, :n] += e**2 * curved
            if size > n:
                direction = self._directions(which, common)
                bright = e**2 * (means.product() + 2 * by @ moved + moved @ curved @ moved)
                g[n:] += (bright - e * T @ (means.image + means.weights * (means.J @ moved))) * direction
                H[n:, n:] += bright * np.outer(direction, direction)
                H[:n, n:] += e**2 * np.outer(by + curved @ moved, direction)
        H[n:, :n] = H[:n, n:].T
        return g / len(self.means), H / len(self.means)

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
        chi_square = ChiSquare.of([self._residual(which)[1] for which in self.means])
        covariance = self._covariance(chi_square.near)
        slopes = np.concatenate(list(self.parameters.slopes(x).values()))
        covariance = covariance[: len(slopes), : len(slopes)]  # without exposures
        error = np.sqrt(np.maximum(np.diag(covariance), 0))
        correlation = covariance / np.maximum(np.outer(error, error), 1e-30)
        values, errors, at = self.parameters.shown(x), {}, 0
        for name, value in values.items():
            errors[name] = (error * slopes)[at : at + len(value)]
            at += len(value)
        off = chi_square.told() + self._brightness(chi_square.near)
        told = off + self.parameters.at_bounds(x) + _ambiguity(values, correlation)
        medium, exposures = surface_of(self.parameters.shape).spec.medium, self.comparison.exposures.tolist()
        return MaterialFit(
            values=values, errors=errors, correlation=correlation, medium=medium, misfit=fitted, held_out=test,
            chi_square=chi_square, exposures=exposures, is_misfit=bool(off), told=told, steps=self.steps, views=views,
        )  # fmt: skip

    def _residual(self, which: int) -> tuple[np.ndarray, np.ndarray]:
        """The residual e I - T of a view by the means of its renders, and its product with the root of the weights."""
        means, view, e = self.means[which], self.comparison.views[which], self.comparison.exposures[which]
        x = np.concatenate([_numbers(each) for each in self.x.values()])
        image = means.image / np.maximum(means.weights, 1e-30) + means.J @ (x - means.x)
        left = np.where(means.weights > 0, e * image - view.image.ravel(), 0.0)
        return left, (left * np.sqrt(means.weights)).reshape(view.image.shape)

    def _covariance(self, alike: float, common: bool = False) -> np.ndarray:
        """The covariance of the variables by residuals r of all pixels, H^-1 (sum w² r² J^T J) H^-1.
        `alike`: factor by which the variance of means is larger, where noise of neighbouring pixels is alike. `common`:
        whether the exposure of all views is a variable too, the last one."""
        pixels, H, squares = 0, 0.0, 0.0
        for which, means in self.means.items():
            e, left = self.comparison.exposures[which], self._residual(which)[0]
            image = means.image / np.maximum(means.weights, 1e-30)
            J = e * np.hstack([means.J, np.outer(image, self._directions(which, common))])
            H = H + (J * means.stiffness[:, None]).T @ J
            squares = squares + (J * np.square(means.weights * left)[:, None]).T @ J
            pixels += int(((means.weights > 0) & (means.J != 0).any(axis=1)).sum())
        inverse = _solved(H, np.eye(len(H)))
        return inverse @ (alike * pixels / max(pixels - len(H), 1) * squares) @ inverse

    def _brightness(self, alike: float) -> list[str]:
        """A sentence if all images together are brighter or darker than any medium makes the scene, or none."""
        x = np.concatenate([_numbers(each) for each in self.x.values()])
        g, H = self._normal(x, common=True)
        step, error = -_solved(H, g)[-1], float(np.sqrt(self._covariance(alike, common=True)[-1, -1]))
        if abs(step) <= CERTAIN * error:
            return []
        return [
            f"all renders times {np.exp(step):.3g} ± {np.exp(step) * error:.1g}, with another medium, would fit "
            "better: check exposures of the images and the power of the lights; the errors above do not include this"
        ]

    def _render(self, which: int, k: int, purpose: str, sloped: bool) -> tuple[np.ndarray, np.ndarray | None]:
        """A render of a view, and derivatives of its pixels by all variables; a channel knows of no other but by g."""
        steps = {name: type(value)(STEP) for name, value in self.x.items()}
        image, found = self.comparison.sloped(which, k, purpose, self.x, self.parameters.put, sloped, steps)
        return image, self._columns(found) if sloped else None

    def _columns(self, found: Sequence[np.ndarray]) -> np.ndarray:
        """The Jacobian of derivatives along each parameter."""
        columns = []
        for name, d in zip(self.parameters.names, found):
            numbers = len(_numbers(self.x[name]))
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


def _numbers(x: mi.Float | mi.Spectrum) -> np.ndarray:
    return np.ravel(np.array(dr.detach(x), dtype=float))


def _ambiguity(values: dict[str, np.ndarray], correlation: np.ndarray) -> list[str]:
    """A sentence on what images cannot tell apart: sigma_t and g, beyond sigma_t (1 - g)."""
    extent = next((name for name in ("sigma_t", "mfp") if name in values), None)
    if extent is None or "g" not in values:
        return []
    places, at = {}, 0
    for name, value in values.items():
        places[name], at = range(at, at + len(value)), at + len(value)
    found = [correlation[i, places["g"][0]] for i in places[extent]]
    told = " ".join(f"{c:.3f}" for c in found)
    return [
        f"correlation of log {extent} and g: {told}; where its size is near 1, images determine sigma_t (1 - g) only"
    ]
