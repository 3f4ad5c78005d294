"""Scenes that several tests of the renderer share."""

from __future__ import annotations

import numpy as np

MEDIUM = {"sigma_s": 1.0, "sigma_a": 0.2, "g": 0.3, "eta": 1.4}


def direction(theta_deg: float, phi: float = 0.0) -> np.ndarray:
    t = np.radians(theta_deg)
    return np.array([np.sin(t) * np.cos(phi), np.sin(t) * np.sin(phi), np.cos(t)])


def surface(model: str = "standard_dipole", orders: str = "multiple", medium: dict = MEDIUM, **more) -> dict:
    return {"type": "translucent", "model": model, "orders": orders, "reflection": False, **medium, **more}


def sun(theta_deg: float, phi: float) -> dict:
    """Parallel light with irradiance 1 across its direction."""
    return {"type": "directional", "direction": (-direction(theta_deg, phi)).tolist(), "irradiance": 1.0}


def plane_scene(bsdf: dict, emitter: dict, theta_o: float, shape: dict | None = None, n: int = 16, **settings) -> dict:
    """A half-space seen by an orthographic camera, each pixel of which should be the same."""
    import mitsuba as mi

    at = mi.ScalarTransform4f()
    view = at.look_at((5 * direction(theta_o)).tolist(), [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": n, "height": n, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "max_depth": 3, **settings},
        "light": emitter,
        "object": {**(shape or {"type": "rectangle", "to_world": at.scale(300.0)}), "bsdf": bsdf},
        "sensor": {"type": "orthographic", "to_world": view, "film": film},
    }


def render(scene: dict, spp: int, seed: int = 1) -> np.ndarray:
    import mitsuba as mi

    return np.array(mi.render(mi.load_dict(scene), spp=spp, seed=seed))


LANES = 2**21  # of a launch; beyond, what it takes to trace a render in Python is small


def independent(scene, n: int, spp: int, seed: int = 1, **film) -> np.ndarray:
    """Independent images of the first sensor, shape (n, height, width, channels).

    A batch of such sensors renders several in one launch: to trace a render in Python takes longer than few samples.
    Walks precompute light for each launch, which images must not share: then each has its own.
    """
    import mitsuba as mi

    sensor, integrator = scene.sensors()[0], scene.integrator()
    width, height = sensor.film().size()
    most = max(LANES // (width * height * spp), 1)
    if hasattr(integrator, "precomputes") and integrator.precomputes(scene, integrator.tracer(scene).visitor.media):
        most = 1
    beside = max(k for k in range(1, n + 1) if n % k == 0 and k <= most)
    film = {"type": "hdrfilm", "width": beside * width, "height": height, "rfilter": {"type": "box"},
            "pixel_format": "rgb", "component_format": "float32", **film}  # fmt: skip
    batch = mi.load_dict({"type": "batch", "film": film, **{f"view{k}": sensor for k in range(beside)}})
    images = [np.array(mi.render(scene, sensor=batch, spp=spp, seed=seed + k), dtype=float) for k in range(n // beside)]
    return np.concatenate([image.reshape(height, beside, width, -1).swapaxes(0, 1) for image in images])


def mean_of_pixels(scene: dict, spp: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the pixels and its standard error, per channel."""
    image = render(scene, spp, seed)
    pixels = image.reshape(-1, image.shape[-1])
    return pixels.mean(axis=0), pixels.std(axis=0, ddof=1) / np.sqrt(len(pixels))
