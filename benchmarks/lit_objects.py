"""Objects in ordinary light, that studies of errors and times render: scans, shapes, and media that vary."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from benchmarks.hand_and_ribbon import SHAPES, STANDING
from benchmarks.methods import ready, volume
from benchmarks.modelling.learnt import object_parts
from benchmarks.modelling.meshes import surface
from benchmarks.modelling.objects import tissue
from benchmarks.published import meat  # noqa: F401  # an object more
from benchmarks.published.fig01 import VIEWS
from figures.computing.scans import SCANS, scan_scene, surroundings
from figures.parts.part import SceneDict
from halfspace_sss import materials
from halfspace_sss.neural.store import weights_in
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    pass

LIGHTS = ("windows", "lamp and sky")
ALL_LIGHTS = (*LIGHTS, "even sky", "small light", "sun and sky")
MODELS = ("full_geometry", "neural_shape", "neural", "better_dipole")
VOLUMES = tuple(volume(depth) for depth in (64, 200))
RESOLUTION = 64  # of modelled objects
ACROSS = 30.0  # mean free paths, of shapes that any material fills
EYE, FAR, FOV = (0.35, 0.2, 1.0), 3.5, 34.0  # of these: direction, distance in their sizes / 2, degrees
# of a lamp: from the middle of the object and radius, in sizes of it, and radiance
LAMP = (0.5, 0.8, 0.6), 0.09, (60.0, 57.0, 52.0)
SMALL = (-0.9, 0.62, -0.6), 0.1, (90.0, 84.0, 75.0)  # behind it, as that of scans
DIM = (0.4, 0.45, 0.5)
SUN = (0.5, 0.6, 0.8)  # towards it
FLOOR = 2.0  # half its side, in sizes of what stands on it


@dataclass(frozen=True)
class LitObject:
    """An object in a light; ValueError if there is none of that name.

    Args:
        name: "SCAN of MATERIAL", "SHAPE of MATERIAL", "candle" or an object whose medium varies.
        light: of `ALL_LIGHTS`.
    """

    name: str
    light: str

    def __post_init__(self) -> None:
        shape, of, _ = self.name.partition(" of ")
        if not (shape in (*SCANS, *SHAPES) if of else shape in VIEWS):
            known = [*(f"{name} of MATERIAL" for name in (*SCANS, *SHAPES)), *VIEWS]
            raise ValueError(f"object must be one of {', '.join(known)}, got {self.name!r}")
        _ = self.medium

    @property
    def key(self) -> str:
        """Id of its shape."""
        return self.name.split()[0]

    @property
    def slug(self) -> str:
        """For names of files."""
        return f"{self.name}, {self.light}".replace(", ", "-").replace(" ", "_")

    @property
    def medium(self) -> Medium:
        """Of a medium that varies any with its mean cosine."""
        _, of, material = self.name.partition(" of ")
        return materials.load(material).medium if of else tissue("candle wax").medium

    def description(self, size: int, folder: Path) -> SceneDict:
        """The scene as a dict, `size` pixels wide."""
        _, of, material = self.name.partition(" of ")
        if self.key in SCANS:
            found = scan_scene(material, size, "small light" if self.light == "small light" else "even sky", self.key)
        elif of:
            found = self._shape(size, folder)
        else:
            view = VIEWS[self.name]
            to_world = mi.ScalarTransform4f().look_at(list(view.origin), list(view.target), [0, 1, 0])
            film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
            shown = object_parts(self.name, RESOLUTION, folder)
            found = {
                "type": "scene",
                "integrator": {"type": "bssrdf", "hide_emitters": True},
                "sensor": {"type": "perspective", "fov": view.fov, "to_world": to_world, "film": film},
                self.name: shown[self.name],
            }
        if self.light == "even sky":
            found["sky"] = {"type": "constant", "radiance": 1.0}
        elif self.light == "windows":
            found["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(surroundings())}
        elif self.light == "sun and sky":
            upright = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
            found["sky"] = {"type": "sunsky", "sun_direction": list(SUN), "to_world": upright}
        elif self.light == "lamp and sky":
            found["lamp"] = self._lamp(found, *LAMP)
            found["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": list(DIM)}}
        elif "lamp" not in found:
            found["lamp"] = self._lamp(found, *SMALL)
        return found

    def _lamp(self, found: SceneDict, towards: Sequence[float], radius: float, glow: Sequence[float]) -> SceneDict:
        box = mi.load_dict({k: v for k, v in found[self.key].items() if k != "bsdf"}).bbox()
        across = float(np.linalg.norm(np.array(box.extents())))
        centre = (np.ravel(np.array(box.center())) + across * np.array(towards)).tolist()
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(glow)}}
        return {"type": "sphere", "center": centre, "radius": radius * across, "emitter": emitter}

    def _shape(self, size: int, folder: Path) -> SceneDict:
        """A shape of `ACROSS` mean free paths."""
        path = folder / f"{self.key}.ply"
        if not path.is_file():
            surface(*SHAPES[self.key](), RESOLUTION).write_ply(path)
        material = self.name.partition(" of ")[2]
        shown = {"type": "ply", "filename": str(path)}
        box = mi.load_dict(shown).bbox()
        centre, across = np.ravel(np.array(box.center())), float(np.linalg.norm(np.array(box.extents())))
        eye = centre + 0.5 * FAR * across * np.array(EYE) / np.linalg.norm(EYE)
        to_world = mi.ScalarTransform4f().look_at(eye.tolist(), centre.tolist(), [0, 1, 0])
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
        mm_per_unit = ACROSS / float(np.median(self.medium.sigma_t)) / across
        floor = {}
        if self.key in STANDING:
            # half a thousandth below what stands there: faces that coincide hide each other by chance
            low = centre - (0, 0.5 * float(np.array(box.extents())[1]) + 5e-4 * across, 0)
            flat = mi.ScalarTransform4f().translate(low.tolist()).rotate([1, 0, 0], -90).scale(FLOOR * across)
            grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}
            floor = {"floor": {"type": "rectangle", "to_world": flat, "bsdf": grey}}
        return {
            "type": "scene",
            "integrator": {"type": "bssrdf", "mm_per_unit": mm_per_unit, "hide_emitters": True},
            "sensor": {"type": "perspective", "fov": FOV, "to_world": to_world, "film": film},
            self.key: {**shown, "bsdf": {"type": "translucent", "material": material}},
            **floor,
        }


def scene_of(case: LitObject, way: str, size: int, folder: Path, **settings: float | str) -> mi.Scene:
    """The Mitsuba scene of a way, or three, with further settings of the integrator."""
    model, _, kind = way.partition(", ")
    found = case.description(size, folder)
    found["integrator"] |= settings
    if kind:
        found["integrator"]["light"] = kind
    return ready(model, found, case.key, case.medium)


def train(case: LitObject, seconds: float, folder: Path) -> float:
    """Learn the object, unless it has been; the CPU seconds that took."""

    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of
    from full_geometry.scenes.scene_files import open_scene
    from full_geometry.transport.storing import KIND, find_weights

    scene = open_scene(case.description(16, folder), KIND)
    learnt = object_of(scene, None, None, case.key)
    with weights_in(folder):
        try:
            find_weights(learnt)
            return 0.0
        except ValueError:
            started = time.process_time()
            train_unattended(learnt, folder, cpu_seconds=seconds)
            return time.process_time() - started
