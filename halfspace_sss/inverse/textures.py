"""The fit of textures: steps of Adam on texels, or on attributes of a mesh, by unbiased gradients.

The gradient of the loss of a view, see `comparing`, is

    mean 2 w J^T ((I + I') / 2 - T),

by one pass backwards whose samples are its own. The variables x are logit albedo or reflectance, log sigma_t or mfp. To
the loss is added `tv` times the mean of |x_i - x_j| over neighbours, the length over channels. Bitmaps begin coarse:
half of the steps go to all resolutions but the last. The rate falls to 0 in the second half.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from halfspace_sss.inverse.comparing import FitStep, MaterialFit, ViewComparison
from halfspace_sss.inverse.parameters import ALBEDO, NEAR, G, check_names, size_bounds, translucent_object
from halfspace_sss.rendering.object.shape import name_of
from halfspace_sss.rendering.object.textured import TexturedMedium, kind_of, shown
from halfspace_sss.rendering.object.wrapped import surface_of
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, open_scene

STEPS = 200
COARSE = 0.5  # part of the steps for all resolutions but the last
FALLING = 0.5  # part of the steps in which the rate falls
LAST = {"albedo": 9.0, "reflectance": 9.0, "g": 2.9}  # size of variables beyond which they are at a bound
EXPOSURE_MEMORY = 0.2  # of the step to the best exposure, what is taken
SMOOTH = 0.01  # added to differences of neighbours, in quadrature


@dataclass(frozen=True, eq=False)
class Variable:
    """A texture or a constant, in variables without bounds.

    Args:
        name: of the parameter.
        key: of the numbers in `mitsuba.traverse`.
        kind: of the numbers there.
        start: these numbers, shape (rows, columns, channels), (n, channels) or (channels,).
        bounds: of the parameter: of sigmoid, of exp, or of tanh for g.
        factor: the parameter over the numbers.
        pairs: neighbours in an attribute of a mesh, shape (n, 2).
    """

    name: str
    key: str
    kind: type
    start: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    factor: float = 1.0
    pairs: np.ndarray | None = None

    @property
    def is_texture(self) -> bool:
        """Whether it is no constant."""
        return self.start.ndim > 1

    def initial(self) -> torch.Tensor:
        """The variables at the start."""
        low, high = self.bounds
        v = self.start * self.factor
        if self.name in ("albedo", "reflectance"):
            s = np.clip((v - low) / (high - low), 1e-3, 1 - 1e-3)
            return torch.tensor(np.log(s / (1 - s)))
        if self.name == "g":
            return torch.tensor(np.arctanh(np.clip(v, -0.95 * G, 0.95 * G) / G))
        return torch.tensor(np.log(np.clip(v, low, high)))

    def parameter(self, x: torch.Tensor) -> torch.Tensor:
        """The parameter of variables."""
        low, high = (torch.tensor(bound) for bound in self.bounds)
        if self.name in ("albedo", "reflectance"):
            return low + (high - low) * torch.sigmoid(x)
        return G * torch.tanh(x) if self.name == "g" else torch.exp(torch.clamp(x, low.log(), high.log()))

    def numbers(self, x: torch.Tensor) -> torch.Tensor:
        """What stands in the scene, of variables at any resolution."""
        return self.parameter(self.resized(x, self.start.shape)) / self.factor

    def resized(self, x: torch.Tensor, shape: Sequence[int]) -> torch.Tensor:
        """A bitmap at another resolution; anything else as it is."""
        if x.ndim != 3 or tuple(x.shape) == tuple(shape):
            return x
        mode = {"mode": "area"} if x.shape[0] > shape[0] else {"mode": "bilinear", "align_corners": False}
        image = torch.nn.functional.interpolate(x.permute(2, 0, 1)[None], tuple(shape[:2]), **mode)
        return image[0].permute(1, 2, 0)

    def shape_at(self, level: int) -> tuple[int, ...]:
        """Of the variables at a resolution, 0 for that of the bitmap."""
        if self.start.ndim != 3:
            return self.start.shape
        return (*(max(-(-n // 2**level), 1) for n in self.start.shape[:2]), self.start.shape[2])

    def variation(self, x: torch.Tensor) -> torch.Tensor:
        """Mean difference of neighbours."""
        if x.ndim == 3:
            steps = (x[1:] - x[:-1], x[:, 1:] - x[:, :-1])
            squares = torch.cat([step.square().sum(-1).ravel() for step in steps])
        else:
            squares = (x[self.pairs[:, 0]] - x[self.pairs[:, 1]]).square().sum(-1)
        return torch.sqrt(squares + SMOOTH**2).mean() if len(squares) else x.sum() * 0

    def at_bound(self, x: torch.Tensor) -> int:
        """How many variables are."""
        if self.name in LAST:
            return int((x.abs() > LAST[self.name]).sum())
        low, high = (torch.tensor(bound).log() for bound in self.bounds)
        share = (x - low) / (high - low)
        return int(((share < NEAR) | (share > 1 - NEAR)).sum())

    def shown(self, numbers: np.ndarray) -> np.ndarray:
        """The parameter as people write it."""
        return 1 / numbers if self.name == "mfp" and not self.is_texture else numbers * self.factor


@dataclass(frozen=True, eq=False)
class TextureParameters:
    """What is fitted of one object with textures.

    Args:
        shape: the object.
        variables: textures and constants.
    """

    shape: mi.Shape
    variables: list[Variable]

    @classmethod
    def of(cls, names: Sequence[str], shape: mi.Shape, mm_per_unit: float, scene: mi.Scene) -> TextureParameters:
        """Of an object.

        Raises:
            ValueError: a name is unknown, there twice, or of another medium than the object's; a texture is neither a
                bitmap nor an attribute of the mesh.
        """
        textured = surface_of(shape).inside.textured
        constants = [name for name in textured.constants if name != "sigma_t"]
        lengths = ["sigma_t", "mfp"] if "sigma_t" in textured.constants else []
        check_names(names, (*textured.textures, *constants, *lengths))
        parameters = mi.traverse(scene)
        return cls(shape, [_variable(name, shape, textured, mm_per_unit, parameters) for name in names])


def _variable(
    name: str, shape: mi.Shape, textured: TexturedMedium, mm_per_unit: float, parameters: mi.SceneParameters
) -> Variable:
    texture, factor, pairs, n = textured.textures.get(name), 1.0, None, len(mi.Spectrum(0))
    if texture is None:
        owner, ending = surface_of(shape), "sigma_t" if name == "mfp" else name
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
        factor *= textured.scale if name == "sigma_t" else 1 / textured.scale
    bounds = _bounds(name, texture is None, textured, shape, mm_per_unit)
    if numbers.shape[-1] < n:  # a colour without hue
        bounds = bounds[0].max(keepdims=True), bounds[1].min(keepdims=True)
    return Variable(name, key, type(parameters[key]), numbers, bounds, factor, pairs)


def _bounds(
    name: str, constant: bool, textured: TexturedMedium, shape: mi.Shape, mm_per_unit: float
) -> tuple[np.ndarray, np.ndarray]:
    n = len(mi.Spectrum(0))
    if name in ("albedo", "reflectance"):
        most = np.broadcast_to(textured.table.most if name == "reflectance" else 1.0, n)
        return ALBEDO[0] * most, ALBEDO[1] * most
    low, high = (-G, G) if name == "g" else size_bounds(shape, mm_per_unit)
    if name == "mfp" and not constant:
        low, high = 1 / high, 1 / low
    return np.full(n, low), np.full(n, high)


def _neighbours(shape: mi.Shape, attribute: str) -> np.ndarray:
    """Vertices that share an edge, or faces that do, shape (n, 2)."""
    faces = np.array(mi.traverse(shape)["faces"], dtype=np.int64).reshape(-1, 3)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    if not attribute.startswith("face_"):
        return np.unique(edges, axis=0)
    order = np.lexsort(edges.T)
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    return np.stack([order[:-1][same], order[1:][same]], axis=1) // 3


class TextureDescent:
    """Steps of Adam on textures and constants.

    Args:
        comparison: of the scene with images.
        parameters: what is fitted.
    """

    def __init__(self, comparison: ViewComparison, parameters: TextureParameters) -> None:
        self.comparison, self.parameters = comparison, parameters
        self.total = comparison.settings.steps or STEPS
        self.steps: list[FitStep] = []
        self.scene_parameters = mi.traverse(comparison.scene)
        variables = parameters.variables
        self.x = {v.name: v.resized(v.initial(), v.shape_at(self._level(0))) for v in variables}
        self.seen = {v.name: np.zeros(v.start.shape, bool) for v in variables if v.is_texture}
        self.adam = self._adam()

    def _adam(self) -> torch.optim.Adam:
        for x in self.x.values():
            x.requires_grad_(True)
        return torch.optim.Adam(self.x.values(), self.comparison.settings.rate)

    def _level(self, k: int) -> int:
        """The resolution of a step."""
        last = self.comparison.settings.levels - 1
        part = COARSE * self.total / max(last, 1)  # steps of each but the last
        return max(last - int(k / part), 0)

    def fingerprint(self) -> str:
        return self.comparison.fingerprint([(v.name, v.start.tolist()) for v in self.parameters.variables])

    def state(self) -> dict[str, np.ndarray]:
        arrays = {f"seen {name}": seen for name, seen in self.seen.items()}
        for name, x in self.x.items():
            kept = {"x": x.detach(), **self.adam.state[x]}
            arrays |= {f"{key} {name}": value.numpy() for key, value in kept.items()}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.seen = {name: arrays[f"seen {name}"] for name in self.seen}
        self.x = {name: torch.tensor(arrays[f"x {name}"]) for name in self.x}
        self.adam = self._adam()
        for name, x in self.x.items():
            self.adam.state[x] = {
                key: torch.tensor(arrays[f"{key} {name}"]) for key in ("step", "exp_avg", "exp_avg_sq")
            }

    # ---- steps

    def step(self, k: int) -> FitStep:
        compared, settings, losses, variance = self.comparison, self.comparison.settings, [], 0.0
        self._resize(self._level(k))
        values = self._put()
        means = {name: numbers.reshape(-1, numbers.shape[-1]).mean(axis=0) for name, numbers in self._shown().items()}
        for which in (views := compared.batch(k)):
            misfit = compared.view(which, k)
            self._backward(which, k, misfit.weights * misfit.residual / len(views))
            if settings.exposure:
                compared.expose(which, -EXPOSURE_MEMORY * misfit.exposure_slope / misfit.exposure_curvature)
            losses.append(misfit.loss)
            variance += misfit.variance / len(views) ** 2
        self.adam.zero_grad()
        for v in self.parameters.variables:
            slope = np.array(dr.grad(self.scene_parameters[v.key]), dtype=float).reshape(v.start.shape)
            values[v.name].backward(torch.tensor(slope))
            if v.is_texture:
                self.seen[v.name] |= slope != 0
                if settings.tv:
                    (settings.tv * v.variation(self.x[v.name])).backward()
        self.adam.param_groups[0]["lr"] = settings.rate * min(1.0, (1 - k / self.total) / FALLING)
        self.adam.step()
        shown = {name: value.tolist() for name, value in means.items()}
        return FitStep(float(np.mean(losses)), float(np.sqrt(variance)), shown)

    def _resize(self, level: int) -> None:
        shapes = {v.name: v.shape_at(level) for v in self.parameters.variables}
        if all(tuple(self.x[name].shape) == shape for name, shape in shapes.items()):
            return
        self.x = {v.name: v.resized(self.x[v.name].detach(), shapes[v.name]) for v in self.parameters.variables}
        self.adam = self._adam()

    def _put(self) -> dict[str, torch.Tensor]:
        """Set textures and constants, with gradients; the numbers that were set, as torch knows them."""
        values = {v.name: v.numbers(self.x[v.name]) for v in self.parameters.variables}
        for v in self.parameters.variables:
            numbers = values[v.name].detach().numpy().astype(np.float32)
            value = v.kind(numbers) if numbers.ndim == 3 else v.kind(numbers.ravel().tolist())
            dr.make_opaque(value)  # as literals they would be code, and each step would compile anew
            dr.enable_grad(value)
            self.scene_parameters[v.key] = value
        self.scene_parameters.update()
        return values

    def _shown(self) -> dict[str, np.ndarray]:
        numbers = {v.name: v.numbers(self.x[v.name].detach()).numpy() for v in self.parameters.variables}
        return {v.name: v.shown(numbers[v.name]) for v in self.parameters.variables}

    def _backward(self, which: int, k: int, weighted: np.ndarray) -> None:
        """Add to the gradients of what was set those of the loss of a view, by its residual times weights."""
        compared, scene = self.comparison, self.comparison.scene
        view = compared.views[which]
        shape = scene.sensors()[view.sensor].film().develop().shape
        slope = np.zeros(shape, np.float32)  # of the loss by pixels
        slope[..., : view.image.shape[2]] = 2 * weighted * compared.exposures[which] / compared.count(which)
        seed = compared.seed(k, which, "slope")
        scene.integrator().render_backward(
            scene, self.scene_parameters, mi.TensorXf(slope), view.sensor, seed, compared.settings.spp
        )

    # ---- the end

    def result(self) -> MaterialFit:
        """Where the steps have ended."""
        self._put()
        for v in self.parameters.variables:
            dr.disable_grad(self.scene_parameters[v.key])
        fitted, held, views = self.comparison.ends(self.total)
        found, told = self._shown(), []
        for v in self.parameters.variables:
            told += self._told(v)
        textures = {v.name: found.pop(v.name) for v in self.parameters.variables if v.is_texture}
        medium = surface_of(self.parameters.shape).inside
        medium = medium.textured.mean(medium.medium.g, medium.medium.eta, self.parameters.shape)
        exposures = self.comparison.exposures.tolist()
        return MaterialFit(
            found, {}, np.zeros((0, 0)), medium, fitted, held, exposures, told, self.steps, views, textures
        )

    def _told(self, v: Variable) -> list[str]:
        """What is at a bound, and what no view sees."""
        x, told = self.x[v.name].detach(), []
        if n := v.at_bound(x):
            told.append(f"{n} of {x.numel()} variables of {v.name} are at a bound")
        if v.is_texture:
            dark = ~self.seen[v.name].reshape(-1, v.start.shape[-1]).any(axis=1)
            if dark.any():
                told.append(
                    f"{int(dark.sum())} of {len(dark)} texels or vertices of {v.name} are seen by no view: they are "
                    "the first guess, or what their neighbours make of it"
                )
        return told


def painted_mesh(scene: str | Path, name: str | None, values: Mapping[str, np.ndarray]) -> bytes:
    """A PLY file of a mesh with attributes of a fit, in the space of the scene.

    Args:
        scene: XML file.
        name: of the object, or None.
        values: by parameter, as of `MaterialFit.textures`.
    """
    shape = translucent_object(open_scene(scene, PATH_TRACED), name)
    parameters, stream = mi.traverse(shape), mi.MemoryStream()
    for key, each in values.items():
        attribute = shown(surface_of(shape).inside.textured.textures[key])[0][1]
        parameters[attribute] = mi.Float(each.ravel().tolist())
    parameters.update()
    shape.write_ply(stream)
    return bytes(stream.raw_buffer())
