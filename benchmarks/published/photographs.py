"""Photographs of a modelled object for a fit: from all around, each under one distant light of its own.

Cameras lie above the horizon, lights anywhere: wide lobes cos^4, which
chance finds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from figures.parts.part import SceneDict
from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

FAR, FOV = 5.0, 24.0  # distance of cameras over the radius of the object; degrees
LEAST_HEIGHT = 0.05  # sine of the elevation of cameras
POWER, LIGHT_ROWS = 4, 64  # of the lobe of a light, and of the map that has it


@dataclass(frozen=True)
class Poses:
    """Cameras and lights of photographs.

    Args:
        centre: that cameras look at, mm.
        eyes: of cameras (n, 3), mm.
        lights: unit vectors towards the lights (n, 3).
    """

    centre: np.ndarray
    eyes: np.ndarray
    lights: np.ndarray

    @classmethod
    def around(cls, low: np.ndarray, high: np.ndarray, n: int, seed: int) -> Poses:
        """n of them about a box."""
        rng, centre = np.random.default_rng([seed, 7]), (low + high) / 2
        up = rng.uniform(LEAST_HEIGHT, 1, n)
        eyes = centre + FAR * 0.5 * np.linalg.norm(high - low) * _unit(up, rng.uniform(0, 2 * np.pi, n))
        return cls(centre, eyes, _unit(rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)))


def _unit(up: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    side = np.sqrt(1 - up * up)
    return np.stack([side * np.cos(azimuth), up, side * np.sin(azimuth)], axis=1)


class Studio:
    """A scene of parts, black but for one distant lobe of light, whose integral is 1.

    Args:
        parts: shapes by name.
        name: of the object among them.
        size: pixels of the square image.
        n: photographs.
        seed: of cameras and lights.
        model: a model, or `PATH_TRACED`.
    """

    def __init__(self, parts: SceneDict, name: str, size: int, n: int, seed: int, model: str = PATH_TRACED) -> None:
        import mitsuba as mi

        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        away = mi.ScalarTransform4f().translate([0, 1e4, 0])  # not in the object, before `set_up`
        self.scene = load_scene(
            {
                "type": "scene",
                "integrator": {"type": "bssrdf", "hide_emitters": True},
                "sensor": {"type": "perspective", "fov": FOV, "film": film, "to_world": away},
                "light": {"type": "envmap", "bitmap": mi.Bitmap(lobe())},
                **parts,
            },
            model,
        )
        self.shape = next(shape for shape in self.scene.shapes() if shape.id() == name)
        box = self.shape.bbox()
        self.poses = Poses.around(*(np.ravel(np.array(v, dtype=float)) for v in (box.min, box.max)), n, seed)
        self.parameters = mi.traverse(self.scene)
        self.keys = {kind: f"{kind}.to_world" for kind in ("sensor", "light")}

    def set_up(self, k: int) -> None:
        """Place camera and light of photograph k, for the next `parameters.update()`."""
        import mitsuba as mi

        T, poses = mi.ScalarTransform4f(), self.poses
        light, eye = poses.lights[k], poses.eyes[k].tolist()
        across = [1, 0, 0] if abs(light[1]) > 0.9 else [0, 1, 0]
        self.parameters[self.keys["sensor"]] = mi.Transform4f(T.look_at(eye, poses.centre.tolist(), [0, 1, 0]))
        turn = T.look_at([0, 0, 0], light.tolist(), across) @ T.rotate([1, 0, 0], 90)  # the lobe is about y
        self.parameters[self.keys["light"]] = mi.Transform4f(turn)

    def photographs(self, spp: int, seed: int) -> np.ndarray:
        """The images of all poses, (n, size, size, 3)."""
        import mitsuba as mi

        results = []
        for k in range(len(self.poses.eyes)):
            self.set_up(k)
            self.parameters.update()
            number = int(np.random.SeedSequence([seed, k]).generate_state(1)[0])
            results.append(np.array(mi.render(self.scene, spp=spp, seed=number))[..., :3])
        return np.array(results)


def lobe() -> np.ndarray:
    """Radiance of a lobe about the upper pole of an environment map, (rows, columns, 3); its integral is 1."""
    cosine = np.cos((np.arange(LIGHT_ROWS) + 0.5) / LIGHT_ROWS * np.pi)
    row = np.maximum(cosine, 0) ** POWER * (POWER + 1) / (2 * np.pi)
    return np.broadcast_to(row[:, None, None], (LIGHT_ROWS, 2 * LIGHT_ROWS, 3)).astype(np.float32)
