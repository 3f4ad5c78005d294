"""Scenes whose images are differentiated, and finite differences of them with the same random numbers."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
from rendered import MEDIUM, direction, surface

from halfspace_sss import Medium, bssrdf

SEED, SPP = 5, 64
ENVMAP = 4 * np.random.default_rng(1).random((4, 8, 3)).astype(np.float32) ** 4
LIGHTS = {
    "sky": {"type": "constant"},
    "lamp": {"type": "sphere", "center": [12, 3, 12], "radius": 2.0, "emitter": {"type": "area", "radiance": 10.0}},
    "point": {"type": "point", "position": [9, 5, 15], "intensity": 200.0},
    "sun": {"type": "directional", "direction": [-0.5, 0.1, -1.0], "irradiance": 3.0},
}
UNTRAINED = ("neural_material", "neural_paper")  # know one medium each


def make(
    light: str | dict = "sky",
    model: str = "standard_dipole",
    n: int = 8,
    floor: bool = True,
    max_depth: int = 4,
    **bsdf,
):
    """A ball over a floor, three media in its channels."""
    medium = {**MEDIUM, "sigma_s": "1, 2, 0.5"}
    orders = bsdf.pop("orders", "total")
    at = mi.ScalarTransform4f()
    sensor = {"type": "perspective", "fov": 20.0, "film": {"type": "hdrfilm", "width": n, "height": n}}
    sensor["to_world"] = at.look_at((30 * direction(50)).tolist(), [0, 0, 0], [0, 0, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "bssrdf", "max_depth": max_depth, "rr_depth": 100, "hide_emitters": True},
        "light": LIGHTS[light] if isinstance(light, str) else light, "sensor": sensor,
        "ball": {"type": "sphere", "radius": 3.0,
                 "bsdf": {**surface(model, orders, medium), "reflection": True, **bsdf}},
    }  # fmt: skip
    if floor:
        board = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.2, 0.5, 0.7]}, "color1": 0.4}
        scene["floor"] = {"type": "rectangle", "to_world": at.translate([0, 0, -3.2]).scale(8.0),
                          "bsdf": {"type": "diffuse", "reflectance": board}}  # fmt: skip
    return mi.load_dict(scene)


def envmap() -> dict:
    return {"type": "envmap", "bitmap": mi.Bitmap(ENVMAP)}


def image(scene, bodies: list | None = None) -> np.ndarray:
    """The image whose derivative the replay gives for the same seed."""
    from full_geometry.integrators.bssrdf import replayer

    integrator = scene.integrator()
    tracer = replayer(bodies or integrator.prepare(scene), integrator.settings)
    return np.array(tracer.render(scene, spp=SPP, seed=SEED), dtype=float)


def weights(scene) -> np.ndarray:
    """A function of the image, so that its pixels count differently."""
    size = scene.sensors()[0].film().crop_size()
    return np.random.default_rng(3).uniform(0.5, 1.5, (size[1], size[0], 3)).astype(np.float32)


def followed(parameters, key: str):
    """The parameter with gradients enabled; some emitters keep a copy of what they are given."""
    value = type(parameters[key])(parameters[key])
    dr.enable_grad(value)
    return value


def derivatives(scene, keys: list[str], by: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Derivatives of the weighted sum of the image by several parameters, of one replay; `by` has other weights."""
    by = weights(scene) if by is None else by
    parameters = mi.traverse(scene)
    values = {key: followed(parameters, key) for key in keys}
    for key, value in values.items():
        parameters[key] = value
    parameters.update()
    scene.integrator().render_backward(scene, parameters, mi.TensorXf(by), 0, SEED, SPP)
    for key, value in values.items():
        parameters[key] = dr.detach(value)
    parameters.update()
    return {key: np.array(dr.grad(value), dtype=float).ravel() for key, value in values.items()}


def backward(scene, key: str) -> np.ndarray:
    return derivatives(scene, [key])[key]


def forward(scene, key: str) -> float:
    """The sum of it over all numbers of the parameter."""
    parameters = mi.traverse(scene)
    value = followed(parameters, key)
    dr.set_grad(value, 1.0)
    parameters[key] = value
    dr.forward_to(parameters[key], flags=dr.ADFlag.ClearEdges)
    parameters.update()
    found = np.array(scene.integrator().render_forward(scene, parameters, 0, SEED, SPP), dtype=float)
    parameters[key] = dr.detach(value)
    parameters.update()
    return float((found * weights(scene)).sum())


class Shifted:
    """Stands in for the `MediumDerivatives` of a body: coefficients of another medium along paths of this one."""

    def __init__(self, body, name: str, h: float, only: int | None) -> None:
        self.spec, self.model, self.media = body.derivatives.spec, body.derivatives.model, []
        for k, m in enumerate(self.spec.channels()):
            ratios = {key: float(getattr(m, key)) for key in ("albedo", "sigma_t", "g")}
            ratios[name] += h if only in (None, k) else 0.0
            self.media.append(Medium.from_albedo(**ratios, eta=m.eta))

    def prepare(self, transport) -> None:
        """Nothing is differentiated by."""

    def transport(self, own):
        """That of the other medium."""
        if own is None:
            return None
        if self.spec.model not in UNTRAINED:
            return own.transport.perturbed(self.media)
        models = []  # by the scaling law, so that the stand-ins keep their weights
        for c, m in zip(self.spec.channels(), self.media):
            one, s = bssrdf(self.spec.model, c.in_mfp()), float(m.sigma_t)
            models.append(type(one)(Medium(one.medium.sigma_s * s, one.medium.sigma_a * s, m.g, m.eta)))
        return dataclasses.replace(own.transport, models=models)

    def coefficients(self, media: list) -> list:
        from full_geometry.geometry.points import opaque

        return [tuple(opaque(v) for v in (m.sigma_s, m.sigma_t, m.g)) for m in self.media]


def varied(body, derivatives):
    return dataclasses.replace(body, derivatives=derivatives, transport=derivatives.transport(body.transport))


def medium_difference(scene, name: str, only: int | None = None) -> tuple[float, float]:
    """Central difference by a coefficient of the medium, with densities held; and the sum of its size over pixels."""
    bodies = scene.integrator().prepare(scene)
    h = {"albedo": 1e-3, "sigma_t": 1e-2, "g": 4e-3}[name]
    sides = []
    for sign in (1, -1):
        shifted = [varied(body, Shifted(body, name, sign * h, only)) for body in bodies]
        sides.append(image(scene, shifted) * weights(scene))
    difference = (sides[0] - sides[1]) / (2 * h)
    return float(difference.sum()), float(np.abs(difference).sum())


def difference(scene, key: str, h: float, kind, bodies: list | None = None) -> float:
    """Central difference; with `bodies`, made before, entries are drawn from the same densities on both sides."""
    parameters = mi.traverse(scene)
    value, sides = kind(parameters[key]), []
    for sign in (1, -1):
        parameters[key] = value + sign * h
        parameters.update()
        sides.append((image(scene, bodies) * weights(scene)).sum())
    parameters[key] = value
    parameters.update()
    return float(sides[0] - sides[1]) / (2 * h)
