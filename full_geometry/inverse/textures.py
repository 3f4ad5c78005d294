"""The fit of textures: Gauss-Newton steps on texels, or on attributes of a mesh, by all that was measured of the views.

Light that leaves an object has the medium of the place where it leaves. So the Jacobian of a pixel p by texels t is

    J_pt = s_p D_pt,

with s_p the derivative of the pixel where all texels change alike, and D_pt the share of texel t in what the pixel
shows of the object, by rays of the camera. Walks give image I and s by the same paths. A view keeps means of both over
steps, and of D v at which they were taken, v the texels; in the first half of the steps a pixel forgets what was
measured far from where its texels are now. A step moves the variables x, logit albedo or reflectance, log sigma_t or
mfp, to the least of

    mean w (e I + e J (v - mean of v) - T)² + tv TV(x),

with v linear in x about where it is, and TV the mean of |x_i - x_j| over neighbours, the length over channels. Where a
model has the medium at both ends, J is not its Jacobian; the residuals are its own, so that what is found is the same
where these vanish. A constant is a texture of one texel.

Standard errors are those of minima that noise moves: the residuals of the last steps and the noise of the means, drawn
anew `DRAWS` times. It holds noise, and not what pixels do not resolve, nor what `tv` smooths away.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import uniform_filter
from scipy.sparse import block_diag, csr_array, diags_array, hstack, kron, vstack
from scipy.sparse.linalg import LinearOperator, cg

from full_geometry.geometry import mesh
from full_geometry.geometry.sensors import camera_rays
from full_geometry.geometry.shape import name_of
from full_geometry.inverse.comparing import (
    LONGEST,
    SETTLING,
    ChiSquare,
    FitStep,
    MaterialFit,
    Variables,
    ViewComparison,
    ViewMisfit,
    arrays_of_means,
    kept_at,
    means_of_arrays,
)
from full_geometry.inverse.parameters import (
    ALBEDO,
    ALPHA,
    NEAR,
    ROUGHNESS,
    G,
    check_names,
    roughness,
    size_bounds,
    translucent_object,
)
from full_geometry.scenes.scene_files import PATH_TRACED, open_scene
from full_geometry.surface.textured import TexturedMedium, kind_of, shown
from full_geometry.surface.wrapped import surface_of

STEPS = 60
STEP = 0.15  # of a parameter, for differences
AVERAGED = (3, 3, 1)  # pixels over which differences are averaged
RAYS = 16  # of a pixel, for D
LAST = {"albedo": 9.0, "reflectance": 9.0, "g": 2.9}  # size of variables beyond which they are at a bound
EXPOSURE_MEMORY = 0.2  # of the step to the best exposure, what is taken
SMOOTH = 0.03  # added to differences of neighbours, in quadrature
DAMPED = 1e-4  # of the mean curvature, added to each
CLOSE, MOST = 1e-2, 100  # relative residual of linear systems, and steps to it
FIELDS = {"reflectance": "albedo", "mfp": "sigma_t"}  # of a medium
DRAWS = 16  # of noise, for standard errors


@dataclass(frozen=True, eq=False)
class Variable:
    """A texture or a constant that is fitted, in variables without bounds.

    Args:
        key: of the numbers in `mitsuba.traverse`.
        kind: of the numbers there.
        start: these numbers, shape (rows, columns, channels), (n, channels) or (channels,).
        bounds: of the parameter: of sigmoid, of exp, or of tanh for g.
        texture: that shows them; None of a constant.
        factor: the parameter over the numbers.
        unit: the parameter over what the texture shows.
        pairs: neighbours, shape (n, 2).
    """

    name: str
    key: str
    kind: type
    start: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    texture: mi.Texture | None = None
    factor: float = 1.0
    unit: float = 1.0
    pairs: np.ndarray | None = None

    @property
    def is_texture(self) -> bool:
        return self.start.ndim > 1

    @property
    def texels(self) -> int:
        """How many; 1 of a constant."""
        return self.start.size // self.start.shape[-1]

    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        return tuple(np.broadcast_to(bound, self.start.shape).ravel() for bound in self.bounds)

    def initial(self) -> np.ndarray:
        """The variables at the start, of all numbers in their order."""
        low, high = self._ends()
        v = self.start.ravel() * self.factor
        if self.name in ("albedo", "reflectance"):
            s = np.clip((v - low) / (high - low), 1e-3, 1 - 1e-3)
            return np.log(s / (1 - s))
        if self.name == "g":
            return np.arctanh(np.clip(v, -0.95 * G, 0.95 * G) / G)
        return np.log(np.clip(v, low, high))

    def clipped(self, x: np.ndarray) -> np.ndarray:
        if self.name in LAST:
            return np.clip(x, -LAST[self.name] - 1, LAST[self.name] + 1)
        return np.clip(x, *map(np.log, self._ends()))

    def parameter(self, x: np.ndarray) -> np.ndarray:
        low, high = self._ends()
        if self.name in ("albedo", "reflectance"):
            return low + (high - low) / (1 + np.exp(-x))
        return G * np.tanh(x) if self.name == "g" else np.exp(x)

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Derivative of the parameter by its variable."""
        v, (low, high) = self.parameter(x), self._ends()
        if self.name in ("albedo", "reflectance"):
            return (v - low) * (high - v) / (high - low)
        return G - v**2 / G if self.name == "g" else v

    def numbers(self, x: np.ndarray, change: ArrayLike = 0.0) -> mi.Float | mi.Spectrum | mi.TensorXf:
        """The numbers that stand in the scene for variables, where what a texture shows changes evenly."""
        numbers = (self.parameter(x) / self.factor).astype(np.float32)
        if np.any(change):
            low, high = (end / self.factor for end in self._ends())
            numbers = numbers.reshape(self.start.shape) + change * self.unit / self.factor
            numbers = np.clip(numbers.ravel(), low, high).astype(np.float32)
        value = self.kind(numbers.reshape(self.start.shape)) if self.start.ndim == 3 else self.kind(numbers.tolist())
        dr.make_opaque(value)  # as literals they would be code, and each step would compile anew
        return value

    def step(self, x: np.ndarray) -> mi.Float | mi.Spectrum:
        """Half the span of a difference: a share of the mean of each channel, of what a texture shows or a constant."""
        v = self.parameter(x).reshape(-1, self.start.shape[-1]).mean(axis=0)
        step = np.full_like(v, STEP) if self.name == "g" else STEP * v
        if self.is_texture:
            return mi.Spectrum((np.broadcast_to(step, len(mi.Spectrum(0))) / self.unit).tolist())
        return self.kind((step / self.factor).tolist())

    def shown(self, x: np.ndarray) -> np.ndarray:
        """The parameter as people write it, in the shape of the start."""
        v = self.parameter(x).reshape(self.start.shape)
        return 1 / v if self.name == "mfp" and not self.is_texture else v

    def at_bound(self, x: np.ndarray) -> int:
        """How many variables are."""
        if self.name in LAST:
            return int((np.abs(x) > LAST[self.name]).sum())
        low, high = map(np.log, self._ends())
        share = (x - low) / (high - low)
        return int(((share < NEAR) | (share > 1 - NEAR)).sum())

    @functools.cached_property
    def differences(self) -> csr_array:
        """The matrix of differences of neighbours, shape (pairs, texels)."""
        m = len(self.pairs) if self.pairs is not None else 0
        i, j = self.pairs.T if m else (np.zeros(0, int),) * 2
        values = np.r_[np.ones(m), -np.ones(m)]
        return csr_array((values, (np.tile(np.arange(m), 2), np.r_[i, j])), (m, self.texels))

    def smoothing(self, x: np.ndarray) -> csr_array:
        """L with L x the gradient of the total variation, for all channels alike, shape (texels, texels)."""
        B, m = self.differences, max(self.differences.shape[0], 1)
        size = np.sqrt(np.square(B @ x.reshape(self.texels, -1)).sum(axis=1) + SMOOTH**2)
        return csr_array(B.T @ diags_array(1 / (m * size)) @ B)

    def places(self, shape: mi.Shape, si: mi.SurfaceInteraction3f, corner: mi.Point2f) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of texels at points of the surface, and their weights there, both of shape (k, points).
        `si`: the points. `corner`: their barycentric coordinates in their face."""
        n = dr.width(si)
        if self.texture is None:
            return np.zeros((1, n), int), np.ones((1, n))
        if self.start.ndim == 3:
            return self._texels_at(si)
        if shown(self.texture)[0][1].startswith("face_"):
            return np.array(si.prim_index, dtype=int)[None], np.ones((1, n))
        u, v = np.array(corner)
        return np.array(mesh.vertices_of(shape, si.prim_index), dtype=int), np.stack([1 - u - v, u, v])

    def _texels_at(self, si: mi.SurfaceInteraction3f) -> tuple[np.ndarray, np.ndarray]:
        """`places` of a bitmap, read off what it shows when texels that are no neighbours hold known numbers."""
        parameters = mi.traverse(self.texture)
        kept, (rows, columns, channels) = parameters["data"], self.start.shape
        most = max(rows, columns)  # numbers are shown over that, as colours are at most 1
        kinds = [np.where((np.arange(n) == n - 1) & (n % 2 == 1), 2, np.arange(n) % 2) for n in (rows, columns)]
        numbers, weights = [], []

        def seen(values: np.ndarray) -> np.ndarray:
            data = np.repeat(values[..., None], channels, axis=2)
            parameters["data"] = mi.TensorXf(np.ascontiguousarray(data, dtype=np.float32))
            parameters.update()
            return np.array(self.texture.eval(si)[0], dtype=float) + np.zeros(dr.width(si))

        # Let the bitmap show texels of one kind of row and column alone, so that a point sees one of them at most:
        # the indicator of the kind is its weight, and row (or column) times indicator over the weight its number.
        for a in np.unique(kinds[0]):
            for b in np.unique(kinds[1]):
                own = ((kinds[0] == a)[:, None] & (kinds[1] == b)).astype(float)
                w = seen(own)
                at = [
                    np.rint(np.divide(most * seen(own * k / most), w, out=np.zeros_like(w), where=w > 1e-4)).astype(int)
                    for k in np.indices(own.shape)
                ]
                numbers.append(at[0] * columns + at[1])
                weights.append(np.where(w > 1e-4, w, 0))
        parameters["data"] = kept
        parameters.update()
        return np.stack(numbers), np.stack(weights)


def variables_of(names: Sequence[str], shape: mi.Shape, mm_per_unit: float, scene: mi.Scene) -> list[Variable]:
    """The textures and constants of an object by name.
    ValueError if a name is unknown, there twice, or of another medium than the object's; a texture is neither a bitmap
    nor an attribute of the mesh."""
    textured = surface_of(shape).spec.textured
    constants = [name for name in textured.constants if name != "sigma_t"]
    lengths = ["sigma_t", "mfp"] if "sigma_t" in textured.constants else []
    check_names(names, (*textured.textures, *constants, *lengths, "alpha"))
    if "alpha" in names:
        roughness(shape)
    parameters = mi.traverse(scene)
    return [_variable(name, shape, textured, mm_per_unit, parameters) for name in names]


def _variable(
    name: str, shape: mi.Shape, textured: TexturedMedium, mm_per_unit: float, parameters: mi.SceneParameters
) -> Variable:
    texture, factor, unit, pairs, n = textured.textures.get(name), 1.0, 1.0, None, len(mi.Spectrum(0))
    if texture is None:
        owner, ending = surface_of(shape), "sigma_t" if name == "mfp" else name
        if name == "alpha":
            owner, ending = mi.traverse(owner).properties[ROUGHNESS][2], "value"
    elif kind_of(texture) == "BitmapTexture":
        owner, ending = texture, "data"
    elif kind_of(texture) == "MeshAttribute":
        owner, ending = shape, shown(texture)[0][1]
        factor, pairs = float(mi.traverse(texture)["scale"]), _neighbours(shape, ending)
    else:
        raise ValueError(
            f"{name} of {name_of(shape)} must be a bitmap or mesh_attribute to be fitted, got a {kind_of(texture)}"
        )
    found = parameters.properties.items()
    key = next(key for key, (_, _, of, _) in found if of is owner and key.rsplit(".", 1)[-1] == ending)
    numbers = np.array(parameters[key], dtype=float)
    if texture is None:
        numbers = np.ravel(numbers)
    elif pairs is not None:
        numbers = numbers.reshape(shape.face_count() if ending.startswith("face_") else shape.vertex_count(), -1)
    if name in ("sigma_t", "mfp") and texture is not None:  # a factor of sigma_t in the scene
        unit = textured.scale if name == "sigma_t" else 1 / textured.scale
    if not dr.is_float_v(type(parameters[key])):
        raise ValueError(
            f"the bitmap of {name} of {name_of(shape)} must have floats to be fitted, got bytes: load it with the "
            "format 'variant'"
        )
    if numbers.shape[-1] not in (1, n):
        raise ValueError(
            f"{name} of {name_of(shape)} must have 1 or {n} channels to be fitted, got {numbers.shape[-1]}"
        )
    bounds = _bounds(name, texture is None, textured, shape, mm_per_unit)
    if numbers.shape[-1] < n:  # a colour without hue
        bounds = bounds[0].max(keepdims=True), bounds[1].min(keepdims=True)
    if numbers.ndim == 3:
        texels = np.arange(numbers[..., 0].size).reshape(numbers.shape[:2])
        beside = ((texels[1:], texels[:-1]), (texels[:, 1:], texels[:, :-1]))
        pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in beside])
    return Variable(
        name=name, key=key, kind=type(parameters[key]), start=numbers, bounds=bounds, texture=texture,
        factor=factor * unit, unit=unit, pairs=pairs,
    )  # fmt: skip


def _bounds(
    name: str, constant: bool, textured: TexturedMedium, shape: mi.Shape, mm_per_unit: float
) -> tuple[np.ndarray, np.ndarray]:
    n = len(mi.Spectrum(0))
    if name in ("albedo", "reflectance"):
        most = np.broadcast_to(textured.table.most if name == "reflectance" else 1.0, n)
        return ALBEDO[0] * most, ALBEDO[1] * most
    if name == "alpha":
        return tuple(np.full(1, alpha) for alpha in ALPHA)
    low, high = (-G, G) if name == "g" else size_bounds(shape, mm_per_unit)
    if name == "mfp" and not constant:
        low, high = 1 / high, 1 / low
    return np.full(n, low), np.full(n, high)


def _neighbours(shape: mi.Shape, attribute: str) -> np.ndarray:
    """Vertices that share an edge, or faces that do, shape (n, 2)."""
    faces = mesh.face_vertices(shape).astype(np.int64)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    if not attribute.startswith("face_"):
        return np.unique(edges, axis=0)
    order = np.lexsort(edges.T)
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    return np.stack([order[:-1][same], order[1:][same]], axis=1) // 3


class PixelMeans:
    """Means of what was measured of a view in the steps, by pixel and channel, nothing at first.
    `weights`, `stiffness`, `image`, `variance`: of renders without exposure times weights, and variance of that mean by
    noise. `slopes`: s of each variable, shape (variables, pixels). `shown`: D of the numbers of each variable there,
    likewise. `renders`, `sloped`: how many the means count for, and of them those of slopes."""

    def __init__(self, pixels: int, variables: int) -> None:
        self.weights = self.stiffness = self.image = self.variance = self.renders = self.sloped = np.zeros(pixels)
        self.slopes = self.shown = np.zeros((variables, pixels))

    def forget(self, shown: np.ndarray, by_x: np.ndarray) -> None:
        """Weigh earlier renders by how far their texels were, in variables: |D v - mean D v| / (D dv/dx)."""
        far = np.abs(shown - self.shown) / np.maximum(by_x, 1e-30)
        kept = kept_at(far.max(axis=0))
        self.renders, self.sloped = kept * self.renders, kept * self.sloped

    def add(
        self, w: np.ndarray, stiffness: np.ndarray, image: np.ndarray, slopes: np.ndarray | None, noise: np.ndarray,
        shown: np.ndarray,
    ) -> None:  # fmt: skip
        """A render more: its image and slopes (None: without them), and the variance of the image by noise."""
        self.renders = self.renders + 1
        b = 1 / self.renders
        self.weights = self.weights + b * (w - self.weights)
        self.stiffness = self.stiffness + b * (stiffness - self.stiffness)
        self.image = self.image + b * (w * image - self.image)
        self.variance = (1 - b) ** 2 * self.variance + b**2 * w**2 * noise
        self.shown = self.shown + b * (shown - self.shown)
        if slopes is not None:
            self.sloped = self.sloped + 1
            self.slopes = self.slopes + (slopes - self.slopes) / self.sloped


@dataclass(frozen=True, eq=False)
class Curvature:
    """J^T w J + L.
    `J`: of pixels of all views by variables. `weights`: of these pixels. `L`: of the total variation."""

    J: csr_array
    weights: np.ndarray
    L: csr_array

    def solved(self, g: np.ndarray) -> np.ndarray:
        """Its inverse times g, damped, by conjugate gradients."""
        diagonal, J_T = self.J.power(2).T @ self.weights + self.L.diagonal(), csr_array(self.J.T)
        damped = max(DAMPED * float(diagonal.mean()), 1e-30)

        def product(x: np.ndarray) -> np.ndarray:
            return J_T @ (self.weights * (self.J @ x)) + self.L @ x + damped * x

        shape = (len(g), len(g))
        scaled = LinearOperator(shape, lambda r: r / (diagonal + damped), dtype=float)
        return cg(LinearOperator(shape, product, dtype=float), g, rtol=CLOSE, maxiter=MOST, M=scaled)[0]


class TextureDescent:
    """Gauss-Newton steps on textures and constants of an object.
    `comparison`: of the scene with images."""

    def __init__(self, comparison: ViewComparison, shape: mi.Shape, variables: list[Variable]) -> None:
        self.comparison, self.shape, self.variables = comparison, shape, variables
        self.total = comparison.settings.steps or STEPS
        self.steps: list[FitStep] = []
        self.scene_parameters = mi.traverse(comparison.scene)
        self.ends = np.cumsum([v.start.size for v in self.variables])[:-1]
        self.x = np.concatenate([v.initial() for v in self.variables])
        self.means: dict[int, PixelMeans] = {}

    def fingerprint(self) -> str:
        return self.comparison.fingerprint([(v.name, v.start.tolist()) for v in self.variables])

    def state(self) -> dict[str, np.ndarray]:
        return {**arrays_of_means(self.means), "x": self.x}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.x, self.means = arrays["x"], means_of_arrays(arrays, PixelMeans)

    # ---- steps

    def step(self, k: int) -> FitStep:
        compared, losses, variance = self.comparison, [], 0.0
        means = {
            v.name: each.reshape(-1, each.shape[-1]).mean(axis=0) for v, each in zip(self.variables, self._shown())
        }
        # Render each view of the step twice, which gives its loss and renews its means.
        for which in (views := compared.batch(k)):
            misfit = self._measure(which, k)
            if compared.settings.exposure:
                compared.expose(which, -EXPOSURE_MEMORY * misfit.exposure_slope / misfit.exposure_curvature)
            losses.append(misfit.loss)
            variance += misfit.variance / len(views) ** 2
        # Move to the least of the quadratic model, H dx = -g, by LONGEST at most.
        H, g = self._normal()
        move = np.clip(H.solved(-g), -LONGEST, LONGEST)
        moved = np.split(self.x + move, self.ends)
        self.x = np.concatenate([v.clipped(x) for v, x in zip(self.variables, moved)])
        told = {name: value.tolist() for name, value in means.items()}
        return FitStep(float(np.mean(losses)), float(np.sqrt(variance)), told)

    def _measure(self, which: int, k: int) -> ViewMisfit:
        """Render a view twice, and add that to its means."""
        compared, view = self.comparison, self.comparison.views[which]
        shown = self._at_pixels(which)
        means = self.means.setdefault(which, PixelMeans(view.image.size, len(self.variables)))
        # Forget what was measured at other texels: D v has moved by |D v - mean D v| / D v' in the variables.
        if k < SETTLING * self.total:
            means.forget(shown, self._at_pixels(which, by_x=True))
        # Render twice with independent samples; differences are measured anew where little is left of them.
        one, both = compared.sloping(np.ceil(means.sloped), [v.name for v in self.variables])
        renders = [self._render(which, k, "first", one), self._render(which, k, "second", both)]
        misfit = compared.view(which, k, [image for image, _ in renders])
        # Add both to the means; the variance of I is that of e I over e², twice that of the mean of the pair.
        w, stiffness = (v.ravel() / compared.count(which) for v in (misfit.weights, misfit.stiffness))
        noise = 2 * misfit.noise.ravel() / compared.exposures[which] ** 2
        for image, slopes in renders:
            means.add(w, stiffness, image.ravel(), slopes, noise, shown)
        return misfit

    def _render(self, which: int, k: int, purpose: str, sloped: bool) -> tuple[np.ndarray, np.ndarray | None]:
        x, steps = self._followed(), {v.name: v.step(x) for v, x in zip(self.variables, self._parts())}
        image, found = self.comparison.sloped(which, k, purpose, x, self._put, sloped, steps)
        if sloped and self.comparison.by_differences:  # their noise would make steps short
            found = [uniform_filter(each, AVERAGED, mode="constant") for each in found]
        return image, np.stack([each.ravel() for each in found]) if sloped else None

    def _put(self, followed: Variables) -> None:
        """Set textures and constants, these with their gradients, and what has those of textures."""
        for v, x in zip(self.variables, self._parts()):
            change = np.ravel(np.array(dr.detach(followed[v.name]), dtype=float))[: v.start.shape[-1]]
            self.scene_parameters[v.key] = v.numbers(x, change) if v.is_texture else followed[v.name]
        self.scene_parameters.update()
        # Differentiate by an even change of each texture, which the surface adds to what its texels show.
        surface = surface_of(self.shape)
        textures = {FIELDS.get(v.name, v.name): followed[v.name] for v in self.variables if v.is_texture}
        surface.spec = surface.spec.with_variables(surface, **textures)

    def _followed(self) -> Variables:
        """Constants, and an even change of each texture."""
        pairs = zip(self.variables, self._parts())
        return {v.name: dr.opaque(mi.Spectrum, 0) if v.is_texture else v.numbers(x) for v, x in pairs}

    @functools.cached_property
    def _footprints(self) -> dict[tuple[int, int], csr_array]:
        """D by (view, variable): shares of texels in pixels, shape (numbers of the image, numbers of the variable)."""
        result = {}
        for which in self.comparison.fitted:
            view = self.comparison.views[which]
            height, width, channels = view.image.shape
            at, si, corner = self._points(which)
            for j, v in enumerate(self.variables):
                # Add the weights of texels up over the rays of a pixel, and scale each row of D to the sum 1.
                texels, weights = v.places(self.shape, si, corner)
                at_texels = np.tile(at, len(texels)), texels.ravel()
                D = csr_array((weights.ravel(), at_texels), (height * width, v.texels))
                D = diags_array(1 / np.maximum(D.sum(axis=1), 1e-30)) @ D
                # Repeat D for each channel of the image: its own of a colour, the one of a grey texture.
                spread = np.eye(channels) if v.start.shape[-1] == channels else np.ones((channels, 1))
                result[which, j] = csr_array(kron(D, spread))
        return result

    def _points(self, which: int) -> tuple[np.ndarray, mi.SurfaceInteraction3f, mi.Point2f]:
        """Pixels, interactions and barycentric coordinates of the rays of a view that meet the object."""
        scene, view = self.comparison.scene, self.comparison.views[which]
        number, sensor = view.sensor if isinstance(view.sensor, int) else which, view.camera(scene)
        film, ray = sensor.film(), camera_rays(sensor, RAYS, (self.comparison.settings.seed, number))
        width, height = (int(n) for n in film.crop_size())
        met = scene.ray_intersect_preliminary(mi.Ray3f(ray[0]))
        # Find the pixel of each ray; positions of a box filter lie on its lower edge, less rounding.
        column, row = (np.floor(np.array(p) + 1e-4).astype(int) - int(o) for p, o in zip(ray[2], film.crop_offset()))
        inside = (0 <= column) & (column < width) & (0 <= row) & (row < height)
        on = met.is_valid() & (met.shape == mi.ShapePtr(self.shape)) & mi.Bool(inside)
        # Keep the rays that meet the object within the crop.
        kept = dr.compress(on)
        ray, met = (dr.gather(type(each), each, kept) for each in (mi.Ray3f(ray[0]), met))
        return (row * width + column)[np.array(kept)], met.compute_surface_interaction(ray), met.prim_uv

    def _parts(self) -> list[np.ndarray]:
        """x of each variable."""
        return np.split(self.x, self.ends)

    def _at_pixels(self, which: int, by_x: bool = False) -> np.ndarray:
        """D v of each variable at the pixels of a view, or D dv/dx, shape (variables, pixels)."""
        of = [(v.slope(x) if by_x else v.parameter(x)) / v.unit for v, x in zip(self.variables, self._parts())]
        return np.stack([self._footprints[which, j] @ each for j, each in enumerate(of)])

    def _jacobian(self, which: int) -> csr_array:
        """The Jacobian e s_p D_pt dv_t/dx_t of the image of a view by x, shape (pixels, variables)."""
        parts = [
            diags_array(s) @ self._footprints[which, j] @ diags_array(v.slope(x) / v.unit)
            for j, (s, v, x) in enumerate(zip(self.means[which].slopes, self.variables, self._parts()))
        ]
        return csr_array(self.comparison.exposures[which] * hstack(parts))

    def _normal(self) -> tuple[Curvature, np.ndarray]:
        """H and g: half the second derivative and half the gradient of loss and total variation at x."""
        # Stack the Jacobians, residuals and weights of all views that have been met, each view with the same weight.
        J = vstack([self._jacobian(which) for which in self.means])
        weights, off = [], []
        for which, means in self.means.items():
            off.append(self._residual(which) / len(self.means))
            weights.append(means.weights / len(self.means))
        # Linearise the total variation about x: |d| is replaced by d² / |d at x|.
        smooth = [kron(v.smoothing(x), np.eye(v.start.shape[-1])) for v, x in zip(self.variables, self._parts())]
        L = 0.5 * self.comparison.settings.tv * csr_array(block_diag(smooth))
        H = Curvature(csr_array(J), np.concatenate(weights), L)
        return H, J.T @ np.concatenate(off) + L @ self.x

    def _residual(self, which: int) -> np.ndarray:
        """w (e I + e J (v - mean v) - T) of a view, by the means of its renders, shape (pixels,)."""
        means, e = self.means[which], self.comparison.exposures[which]
        moved = e * (means.slopes * (self._at_pixels(which) - means.shown)).sum(axis=0)
        return e * means.image + means.weights * (moved - self.comparison.views[which].image.ravel())

    # ---- the end

    def _shown(self) -> list[np.ndarray]:
        return [v.shown(x) for v, x in zip(self.variables, self._parts())]

    def result(self) -> MaterialFit:
        """Where the steps have ended."""
        self._put(self._followed())
        fitted, held, views = self.comparison.ends(self.total)
        # Test residuals over the root of their weights, whose noise is alike in all pixels.
        residuals = [
            (self._residual(which) / np.sqrt(np.maximum(means.weights, 1e-30))).reshape(
                self.comparison.views[which].image.shape
            )
            for which, means in self.means.items()
        ]
        chi_square = ChiSquare.of(residuals)
        errors, told = self._errors(), chi_square.told()
        for v, x, error in zip(self.variables, self._parts(), errors):
            told += self._told(v, x, error)
        # Part constants from textures.
        found = {v.name: (v.is_texture, *each) for v, *each in zip(self.variables, self._shown(), errors)}
        (values, errors), (textures, texture_errors) = (
            [{name: each[j] for name, each in found.items() if each[0] == kind} for j in (1, 2)]
            for kind in (False, True)
        )
        medium = surface_of(self.shape).spec
        medium = medium.textured.mean(medium.medium.g, medium.medium.eta, self.shape)
        exposures = self.comparison.exposures.tolist()
        return MaterialFit(
            values=values, errors=errors, correlation=np.zeros((0, 0)), medium=medium, misfit=fitted, held_out=held,
            chi_square=chi_square, exposures=exposures, is_misfit=chi_square.is_misfit, told=told, steps=self.steps,
            views=views, textures=textures, texture_errors=texture_errors,
        )  # fmt: skip

    def _errors(self) -> list[np.ndarray]:
        """Standard errors by noise, in the shape of each variable; NaN where no view shows a texel."""
        # Estimate the variance of a residual by the loss of the last steps, or by its spread where that is larger.
        last = np.array([step.loss for step in self.steps[int(SETTLING * self.total) :]])
        loss = max(float(last.mean()), float(last.std() / np.sqrt(len(last))))
        rng, H = np.random.default_rng([self.comparison.settings.seed, 7]), self._normal()[0]
        # Let noise of images and of renders move the minimum: dx = H^-1 J^T (noise), DRAWS times.
        stiffness = np.concatenate([means.stiffness for means in self.means.values()]) / len(self.means)
        H = replace(H, weights=np.maximum(stiffness, 0))
        variance = np.concatenate([
            means.weights * loss / self.comparison.count(which)
            + self.comparison.exposures[which] ** 2 * means.variance
            for which, means in self.means.items()
        ])  # fmt: skip
        noise = np.sqrt(variance) / len(self.means)
        moves = [H.solved(H.J.T @ (noise * rng.standard_normal(len(noise)))) for _ in range(DRAWS)]
        error = np.where(abs(H.J).sum(axis=0) > 0, np.sqrt(np.mean(np.square(moves), axis=0)), np.nan)
        return [
            (each * (np.abs(v.shown(x)).ravel() if v.name == "mfp" else v.slope(x))).reshape(v.start.shape)
            for v, x, each in zip(self.variables, self._parts(), np.split(error, self.ends))
        ]

    def _told(self, v: Variable, x: np.ndarray, error: np.ndarray) -> list[str]:
        """Sentences on variables at a bound and texels that no view sees."""
        told, dark = [], np.isnan(error.reshape(v.texels, -1)).any(axis=1)
        if n := v.at_bound(x):
            told.append(f"{n} of {x.size} variables of {v.name} are at a bound")
        if dark.any():
            told.append(
                f"{int(dark.sum())} of {len(dark)} texels or vertices of {v.name} are seen by no view: they keep "
                "the first guess or follow their neighbours, and their errors are NaN"
            )
        return told


def painted_mesh(scene: str | Path, name: str | None, values: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> bytes:
    """A PLY file of a mesh with attributes of a fit and their standard errors, in the space of the scene.
    `scene`: XML file. `name`: of the object, or None. `values`: by parameter, as of `MaterialFit.textures` and
    `MaterialFit.texture_errors`."""
    shape = translucent_object(open_scene(scene, PATH_TRACED), name)
    parameters, stream = mi.traverse(shape), mi.MemoryStream()
    for key, (each, errors) in values.items():
        attribute = shown(surface_of(shape).spec.textured.textures[key])[0][1]
        parameters[attribute] = mi.Float(each.ravel().tolist())
        shape.add_attribute(f"{attribute}_error", errors.shape[-1], errors.ravel().tolist())
    parameters.update()
    shape.write_ply(stream)
    return bytes(stream.raw_buffer())
