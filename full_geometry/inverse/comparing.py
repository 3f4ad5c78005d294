"""Renders of views against their images, and the state of a fit between its steps.

With two renders I, I' of independent samples, an image T and weights w, the loss of a view is

    mean w (I - T) (I' - T),

in which noise has no bias (Deng et al. 2022 take the product of two renders too). Weights are 1 ("l2"), or
1 / (B + a tenth of the mean of T)² ("relative"), with B the mean of earlier renders. "robust" makes that the loss of
Huber (1964), by weights that are found anew in each step: with r = |I'' - T| / (B + a tenth of the mean of T) of a
third render I'', they are

    1 / (B + a tenth of the mean of T)² / max(1, r / 5 %)

over the mean of their last factor. B and I'' know nothing of the noise of T or of the renders that are compared.
Weights by T would be small where its noise is bright, so that what is found would be too dark. The noise of I'' blurs
the bend at 5 %. Where the loss bends, its slope does not grow with I: there w (1 - (I - T) / (I'' - T)) takes the place
of w in its second derivative.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from full_geometry.geometry.sensors import seeded
from full_geometry.geometry.snapshot import scene_hash
from full_geometry.inverse.views import GivenView, edit
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import provenance

LOSSES = ("relative", "l2", "robust")
LIGHTS = ("sampled", "precomputed")
STEPPED = ("alpha",)  # parameters whose derivatives are differences
SLOPES = 2  # differences of a pixel, after which they are kept
FLOOR = 0.1  # of the mean of an image, added to it in relative weights
BEND = 0.05  # relative residual, beyond which the robust loss grows by its size
EXPOSURE = 10.0  # most, of a factor
BATCH = 4
SETTLING = 0.5  # part of the steps after which nothing is forgotten
FAR = 0.15  # change of a variable at which what was measured counts half
LONGEST = 0.7  # change of a variable in a step
PURPOSES = ("order", "first", "second", "slope", "test", "other test", "weights")
FIRST = 4  # renders for the weights of a view that is met first
NEWEST = 0.25  # share of the renders of a step in those for the weights of the next
NEAR, FAR_OFF = 1, 3  # pixels: in NEAR noise may be alike, from there to FAR_OFF it is not
CERTAIN = 4.0  # standard errors by which a chi-square is told to be a misfit
Variables = Mapping[str, "mi.Float | mi.Spectrum"]  # by name


@dataclass(frozen=True)
class FitSettings:
    """How to fit.

    Args:
        steps: how many; 0 takes 30, or 60 where textures are fitted.
        spp: samples a pixel of each render of a view: two images, and its slopes.
        batch: views a step; 0 takes 4 or all, whichever is less.
        loss: "relative", "l2" or "robust".
        exposure: whether each image may have a factor of its own, of geometric mean 1.
        seed: of all samples.
        tv: weight of the total variation of textures in their variables.
        light: of `translucent_walk`: "sampled", or "precomputed", with far less noise from lamps, above all below a
            rough boundary; derivatives then are differences of renders with the same random numbers.
        test_spp: samples a pixel of each of the two renders that test a view that is held out; 0 takes spp.
    """

    steps: int = 0
    spp: int = 64
    batch: int = 0
    loss: str = "relative"
    exposure: bool = False
    seed: int = 0
    tv: float = 0.02
    light: str = "sampled"
    test_spp: int = 0

    def __post_init__(self) -> None:
        for name, least in (("steps", 0), ("spp", 1), ("batch", 0), ("seed", 0), ("test_spp", 0)):
            check_count(name, getattr(self, name), least)
        check_choice("loss", self.loss, LOSSES)
        check_choice("light", self.light, LIGHTS)
        check_interval("tv", self.tv, 0.0, 1e6)


class FitStep(NamedTuple):
    """Loss of the views of a step, its standard error by noise, and the parameters before it; of textures the means."""

    loss: float
    error: float
    values: dict[str, list[float]]

    def line(self) -> str:
        numbers = "; ".join(f"{name} {' '.join(f'{v:.4g}' for v in value)}" for name, value in self.values.items())
        return f"loss {self.loss:.3g} ± {self.error:.1g}  {numbers}"


class ChiSquare(NamedTuple):
    """chi² of means of residuals over neighbouring pixels, per degree of freedom: 1 if each pixel has noise of its own.

    With residuals z of pixels p in a standard of their own, sums over pixels q further away than `NEAR` and as near as
    `FAR_OFF`, and correlations c of pixels as near as `NEAR`,

        chi² = 1 + sum z_p z_q / sum z_p²,    of the error (sum c²) sqrt(sum 2 z_p² z_q²) / sum z_p².

    So the noise of images need not be known, and may be alike in pixels that touch, as after a filter.

    Args:
        value, error: chi², and its standard error if all is noise.
        near: the sum of c, at least 1: the variance of means over that of noise of each pixel.
    """

    value: float
    error: float
    near: float

    @classmethod
    def of(cls, residuals: Sequence[np.ndarray]) -> ChiSquare:
        """The chi² of residuals (height, width, channels), which are 0 where nothing counts."""
        far, variance, squares = 0.0, 0.0, 1e-30
        shifts = [(i, j) for i in range(-NEAR, NEAR + 1) for j in range(-NEAR, NEAR + 1)]
        near = np.zeros(len(shifts))
        for z in residuals:
            z2, padded = z**2, np.pad(z, [(NEAR, NEAR), (NEAR, NEAR), (0, 0)])
            squares += float(z2.sum())
            far += float((z * (neighbour_sums(z, FAR_OFF) - neighbour_sums(z, NEAR))).sum())
            variance += 2 * float((z2 * (neighbour_sums(z2, FAR_OFF) - neighbour_sums(z2, NEAR))).sum())
            h, w, _ = z.shape
            near += [(z * padded[NEAR + i : NEAR + i + h, NEAR + j : NEAR + j + w]).sum() for i, j in shifts]
        near /= squares
        error = float(np.square(near).sum() * np.sqrt(variance)) / squares
        return cls(1 + far / squares, error, max(1.0, float(near.sum())))

    @property
    def is_misfit(self) -> bool:
        """Whether noise does not explain it."""
        return self.value - 1 > CERTAIN * self.error

    def told(self) -> list[str]:
        """A sentence about a misfit, or none."""
        if not self.is_misfit:
            return []
        return [
            f"noise does not explain the residuals ({(self.value - 1) / self.error:.0f} standard errors): lights, "
            "cameras, exposures, shape, index or boundary of the scene are not those of the images, or steps are too "
            "few; the errors above do not include this"
        ]


def neighbour_sums(z: np.ndarray, reach: int) -> np.ndarray:
    """Sums over squares of pixels about each pixel of an image (height, width, channels)."""
    side = 2 * reach + 1
    return side**2 * uniform_filter(z, (side, side, 1), mode="constant")


class FittedView(NamedTuple):
    """A given image and what was found, (height, width, channels); which pixels count, and whether it only tests."""

    name: str
    given: np.ndarray
    found: np.ndarray
    counts: np.ndarray
    held_out: bool

    @property
    def relative_l1(self) -> float:
        """Sum of |found - given| over that of given, of pixels as they count; noise of the render is in it."""
        off, given = (self.counts[..., None] * each for each in (np.abs(self.found - self.given), self.given))
        return float(off.sum() / given.sum())


@dataclass(frozen=True)
class MaterialFit:
    """The result of a fit.

    Args:
        values: of each parameter that is the same everywhere; sigma_t in 1/mm, mfp in mm.
        errors: standard errors by H, the misfit, and the noise of the steps.
        correlation: of all numbers in the order of `values`; empty beside textures.
        medium: of the object; with textures their means.
        misfit: root of the loss of all fitted views at the end.
        held_out: likewise of views held out; None without any.
        chi_square: of the fitted views.
        exposures: factor of each view's image of the medium that matches the given one.
        is_misfit: whether more than noise is between images and renders.
        told: sentences about that, about bounds, and about what the images do not tell.
        steps: the way there.
        views: what each view shows beside its given image.
        textures: of each parameter that has one, the texels (rows, columns, channels), or the attribute of each vertex
            or face, shape (n, channels).
        texture_errors: their standard errors by noise, NaN where no view shows a texel.
    """

    values: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    correlation: np.ndarray
    medium: Medium
    misfit: NoiseFree
    held_out: NoiseFree | None
    chi_square: ChiSquare
    exposures: list[float]
    is_misfit: bool
    told: list[str]
    steps: list[FitStep] = field(repr=False)
    views: list[FittedView] = field(default_factory=list, repr=False)
    textures: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    texture_errors: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    def lines(self) -> list[str]:
        """Each parameter with its errors, and the misfit."""
        told = []
        for name, value in self.values.items():
            errors = [f" ± {e:.1g}" for e in self.errors[name]]
            told.append(f"{name}: {'  '.join(f'{v:.4g}{e}' for v, e in zip(value, errors))}")
        for name, values in self.textures.items():
            mean = " ".join(f"{v:.4g}" for v in values.reshape(-1, values.shape[-1]).mean(axis=0))
            size, error = " x ".join(map(str, values.shape[:-1])), self.texture_errors[name]
            known = f"{np.nanmedian(error):.1g}" if np.isfinite(error).any() else "nan"
            told.append(f"{name}: {size} numbers of mean {mean}, median of their errors {known}")
        held = "" if self.held_out is None else f", of views held out {self.held_out.told()} %"
        word, chi_square = "misfit" if self.is_misfit else "noise", self.chi_square
        residuals = f"residuals: {word}, chi-square {chi_square.value:.2f}, noise gives 1 ± {chi_square.error:.1g}"
        if held:
            medians = (np.median([v.relative_l1 for v in self.views if v.held_out == out]) for out in (False, True))
            held += ", median relative L1 of views {:.1%}, of those held out {:.1%}".format(*medians)
        return [*told, f"weighted RMS residual {self.misfit.told()} %{held}", residuals]


class ViewMisfit(NamedTuple):
    """The comparison of two renders of a view with its image.

    Args:
        loss, variance: of the view, and its variance by noise.
        residual: mean of both renders times the exposure e, less the image.
        noise: its variance, of all pixels.
        weights: of pixels and channels.
        stiffness: what stands for weights in the second derivative of the loss.
        exposure_slope, exposure_curvature: half the derivatives of the loss by ln e, of Gauss and Newton.
    """

    loss: float
    variance: float
    residual: np.ndarray
    noise: np.ndarray
    weights: np.ndarray
    stiffness: np.ndarray
    exposure_slope: float
    exposure_curvature: float


class ViewComparison:
    """The views of a scene as it is now, against their images.
    `scene`, `views`, `settings`: as of `fit`, checked. `factors`: of each view, changed in place: of its render to its
    image, up to one common factor. `shown`: of views that were met, changed in place: B, without exposure."""

    def __init__(self, scene: mi.Scene, views: list[GivenView], settings: FitSettings) -> None:
        self.scene, self.views, self.settings = scene, views, settings
        self.factors, self.shown = np.ones(len(views)), {}

    @property
    def fitted(self) -> list[int]:
        """The views that are not held out."""
        return [k for k, view in enumerate(self.views) if not view.held_out]

    @property
    def exposures(self) -> np.ndarray:
        """The factors of views over the geometric mean of those that are fitted."""
        return self.factors / np.exp(np.log(self.factors[self.fitted]).mean())

    def batch(self, k: int) -> list[int]:
        n = min(self.settings.batch or BATCH, len(self.fitted))
        return np.random.default_rng([self.settings.seed, k]).permutation(self.fitted)[:n].tolist()

    def count(self, which: int) -> float:
        """Numbers of a view that count."""
        view = self.views[which]
        return max(float(view.counts.sum() * view.image.shape[2]), 1.0)

    def seed(self, k: int, which: int, purpose: str, parameter: int = 0) -> int:
        return seeded(self.settings.seed, k, which, PURPOSES.index(purpose), parameter)

    def view(self, which: int, k: int, pair: Sequence[np.ndarray] = ()) -> ViewMisfit:
        """Compare a view with its image in step k; a view that is held out takes the exposure that suits it best.
        `k`: number of the step, which seeds the renders. `pair`: two renders of the view, if there are any; by default
        they are made."""
        view = self.views[which]
        purposes = ("test", "other test") if view.held_out else ("first", "second")
        pair = pair or [self.image(view, self.seed(k, which, each)) for each in purposes]
        weights = self._weights(which, k)
        misfit = self._misfit(which, pair, *weights)
        if self.settings.exposure and view.held_out:
            self.expose(which, -misfit.exposure_slope / misfit.exposure_curvature)
            misfit = self._misfit(which, pair, *weights)
        if which in self.shown:
            self.shown[which] = self.shown[which] + NEWEST * (np.mean(pair, axis=0) - self.shown[which])
        return misfit

    def _weights(self, which: int, k: int) -> tuple[np.ndarray, np.ndarray | float]:
        """Weights w of pixels and channels in step k, 0 where they do not count; and 1 / (I'' - T) at bends."""
        view, e = self.views[which], self.exposures[which]
        counts = np.broadcast_to(view.counts[..., None], view.image.shape).astype(float)
        if self.settings.loss == "l2":
            return counts, 0.0
        # Weigh by 1 / (B + floor)², B from renders that are compared with nothing: T and its noise stay out of it.
        if which not in self.shown:
            seeds = [self.seed(k, which, "weights", number) for number in range(FIRST)]
            self.shown[which] = np.mean([self.image(view, seed) for seed in seeds], axis=0)
        floor = FLOOR * max(float(view.image[view.counts > 0].mean()), 1e-6)
        scale = e * np.maximum(self.shown[which], 0) + floor
        weights = counts / np.square(scale)
        if self.settings.loss != "robust":
            return weights, 0.0
        # Bend the loss of Huber by a third render: weights fall as 1 / |r| beyond BEND.
        off = e * self.image(view, self.seed(k, which, "weights", FIRST)) - view.image
        factor = 1 / np.maximum(np.abs(off) / scale / BEND, 1)
        bent = np.divide(1.0, off, out=np.zeros_like(off), where=factor < 1)
        return weights * factor / factor[view.counts > 0].mean(), bent

    def _misfit(self, which: int, pair: Sequence[np.ndarray], w: np.ndarray, bent: np.ndarray | float) -> ViewMisfit:
        e, T, n = self.exposures[which], self.views[which].image, self.count(which)
        # Compare both renders with the image: the product of independent residuals a b has no bias by noise.
        a, b = (e * image - T for image in pair)
        noise = np.square(a - b) / 2  # variance of each
        variance = float((np.square(w) * (noise * (np.square(a) + np.square(b)) / 2)).sum()) / n**2
        loss, residual = float((w * a * b).sum() / n), (a + b) / 2
        # Derive the loss by ln e: d(e I)/d ln e = a + T, so that the slope is mean w (a + T) b.
        slope = loss + float((w * T * residual).sum() / n)
        curvature = float((w * (a + T) * (b + T)).sum() / n)
        return ViewMisfit(
            loss=loss, variance=variance, residual=residual, noise=noise / 2, weights=w,
            stiffness=w * (1 - residual * bent), exposure_slope=slope, exposure_curvature=curvature,
        )  # fmt: skip

    def ends(self, k: int) -> tuple[NoiseFree, NoiseFree | None, list[FittedView]]:
        """The root of the loss of all fitted views, and likewise of views held out (None without any); all views."""
        misfits = [self.view(which, k) for which in range(len(self.views))]
        losses = [(m.loss, m.variance) for m in misfits]
        held = [loss for loss, view in zip(losses, self.views) if view.held_out]
        shown = [
            FittedView(view.name, view.image, m.residual + view.image, view.counts, view.held_out)
            for view, m in zip(self.views, misfits)
        ]
        return _root([losses[which] for which in self.fitted]), _root(held) if held else None, shown

    def image(self, view: GivenView, seed: int) -> np.ndarray:
        """A render of a view, without exposure."""
        edit(self.scene, view)
        spp = (view.held_out and self.settings.test_spp) or self.settings.spp
        return pixels_of(view, mi.render(self.scene, sensor=view.sensor, seed=seed, spp=spp))

    @property
    def at_once(self) -> bool:
        """Whether image and derivatives come from the same paths; models take a pass for each variable."""
        return hasattr(self.scene.integrator(), "render_derivatives") and not self.by_differences

    @property
    def by_differences(self) -> bool:
        """Whether all derivatives are differences of renders: those of precomputed light."""
        return getattr(self.scene.integrator(), "light", "") == "precomputed"

    def sloping(self, measured: np.ndarray | float, names: Iterable[str]) -> tuple[bool, bool]:
        """Whether the first and the second render of a view are to have derivatives.
        Differences take further renders, and those by pixels are kept; of models there is little left for products of
        different renders once there are derivatives. `measured`: how many derivatives the means of the view, or of its
        pixels, count for. `names`: of variables."""
        if self.by_differences or set(names) & set(STEPPED):
            return bool(np.ndim(measured) == 0 or np.median(measured) < SLOPES), False
        return True, bool(self.at_once or np.max(measured) < 1)

    def sloped(
        self, which: int, k: int, purpose: str, x: Variables, put: Callable[[Variables], None],
        slopes: bool, steps: Variables,
    ) -> tuple[np.ndarray, list[np.ndarray]]:  # fmt: skip
        """A render of a view in a step, and its derivatives by each variable, all of whose numbers change alike.

        Args:
            purpose: "first" or "second".
            x: the variables by name.
            put: sets the medium by them, with their gradients.
            slopes: whether derivatives are asked for.
            steps: of differences, by name.
        """
        stepped = [name for name in x if self.by_differences or name in STEPPED] if slopes else []
        if not stepped:
            return self._followed(which, k, purpose, x, put, slopes)
        image, found = None, {}
        if rest := [name for name in x if name not in stepped]:
            image, slopes_of_rest = self._followed(which, k, purpose, x, put, True, rest)
            found = dict(zip(rest, slopes_of_rest))
        # Move each variable in turn, with the same random numbers: (I(x + step) - I(x - step)) / 2 step.
        view, seed = self.views[which], self.seed(k, which, purpose)
        for name in stepped:
            ends = []
            for sign in (1, -1):
                moved = {**x, name: x[name] + sign * steps[name]}
                dr.make_opaque(moved[name])
                put(moved)
                ends.append(self.image(view, seed))
            found[name] = (ends[0] - ends[1]) / np.ravel(2 * np.array(steps[name], dtype=float))
        put(x)
        return self.image(view, seed) if image is None else image, [found[name] for name in x]

    def _followed(
        self, which: int, k: int, purpose: str, x: Variables, put: Callable[[Variables], None], slopes: bool,
        names: Sequence[str] = (),
    ) -> tuple[np.ndarray, list[np.ndarray]]:  # fmt: skip
        """`sloped` by derivatives that the integrator follows, by all variables or those of some names."""
        view, spp, integrator = self.views[which], self.settings.spp, self.scene.integrator()
        names = names or list(x)
        edit(self.scene, view)
        seed, found = self.seed(k, which, purpose), []

        def followed(names: Iterable[str]) -> Variables:
            result = {name: type(value)(value) for name, value in x.items()}
            for name in names:
                dr.enable_grad(result[name])
            return result

        if slopes and self.at_once:
            followed_x = followed(names)
            put(followed_x)
            by = [followed_x[name] for name in names]
            image, found = integrator.render_derivatives(self.scene, by, view.sensor, seed, spp)
            put(x)
            return pixels_of(view, image), [pixels_of(view, d) for d in found]
        put(x)
        image = self.image(view, seed)
        for j, name in enumerate(names if slopes else ()):
            followed_x = followed([name])
            dr.set_grad(followed_x[name], 1.0)
            put(followed_x)
            dr.forward_from(followed_x[name], dr.ADFlag.ClearEdges)  # models begin at the coefficients
            seed = self.seed(k, which, "slope", 2 * j + (purpose == "second"))
            found.append(pixels_of(view, integrator.render_forward(self.scene, None, view.sensor, seed, spp)))
        put(x)
        return image, found

    def expose(self, which: int, share: float) -> None:
        """Add a share to the factor of a view."""
        factor = self.factors[which] * (1 + np.clip(share, -0.5, 1.0))
        self.factors[which] = np.clip(factor, 1 / EXPOSURE, EXPOSURE)

    def fingerprint(self, *start: object) -> str:
        """A hash of the scene, the images, the settings, the start of a fit, and versions."""
        views = [(v.sensor if isinstance(v.sensor, int) else str(v.sensor), v.held_out, v.edits) for v in self.views]
        told = provenance()
        scene = scene_hash(self.scene, self.scene.integrator())
        of = [scene, asdict(self.settings), start, views, told["versions"], told["commit"]]
        digest = hashlib.sha256(json.dumps(of).encode())
        for view in self.views:
            digest.update(view.image.tobytes() + view.counts.tobytes())
        return digest.hexdigest()


def pixels_of(view: GivenView, image: mi.TensorXf) -> np.ndarray:
    """A render in the shape of the image of a view."""
    return np.array(image, dtype=np.float64)[..., : view.image.shape[2]]


def _root(losses: Sequence[tuple[float, float]]) -> NoiseFree:
    """The root of a mean loss, of losses and their variances."""
    loss, variance = np.mean(losses, axis=0)
    return NoiseFree(float(loss), float(np.sqrt(variance / len(losses))))


def kept_at(change: np.ndarray | float) -> np.ndarray | float:
    """Share that is kept of what was measured before a variable changed by so much."""
    return 1 / (1 + (change / FAR) ** 4)


def arrays_of_means(means: Mapping[int, Any]) -> dict[str, np.ndarray]:
    """Means of views, of arrays and numbers, as a state keeps them."""
    return {
        f"view {which} {key}": np.asarray(value) for which, each in means.items() for key, value in vars(each).items()
    }


def means_of_arrays(arrays: Mapping[str, np.ndarray], kind: Callable[[int, int], Any]) -> dict[int, Any]:
    """The means that a state keeps, of a class that begins with numbers of pixels and of variables."""
    kept: dict[int, Any] = {}
    for key, value in arrays.items():
        if key.startswith("view "):
            _, which, name = key.split()
            setattr(kept.setdefault(int(which), kind(0, 0)), name, value if value.ndim else float(value))
    return kept
