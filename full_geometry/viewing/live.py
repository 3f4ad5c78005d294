"""A scene that is looked at while it is changed: edits of it, and its images in passes. No page is needed for it."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.sensors import seeded
from full_geometry.geometry.snapshot import differing
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.objects.objects import translucent_shapes
from full_geometry.precomputed.unscattered_light import ImageSamples
from full_geometry.scenes.gltf import is_gltf
from full_geometry.scenes.reference import check_sensor
from full_geometry.scenes.reference_store import Reference, finite_pixels
from full_geometry.scenes.scene_files import first_cause, open_scene, parsed, put
from full_geometry.settings import OF_MITSUBA, PATH_TRACED, SHARED
from full_geometry.surface.wrapped import surface_of
from full_geometry.trade.denoising import Denoiser
from full_geometry.trade.image_differences import flip_ldr, srgb
from full_geometry.viewing.edits import (
    Camera,
    Edits,
    Way,
    change,
    integrator_props,
    name_nodes,
    names_of,
    put_camera,
    put_integrator,
)
from full_geometry.walk.random_walk import on_device
from halfspace_sss.interrupts import cancellable
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import write_atomically

COARSE = 4  # one of so many pixels of each row and column comes first
BRIEF = 0.15  # seconds; passes that take longer have no more samples, as edits wait for one
SHARE = 4  # a pass has at most a quarter of the samples so far
SAMPLES_OF_LIGHT = 2**20  # that light inside serves at most, as edits wait for it
LIT = 2  # samples; at twice as many, walks find more light than a preview has
MOST = 4096  # samples of a pixel
GUIDE_SPP = 4
MAPS = (".exr", ".hdr")


class Shown(NamedTuple):
    """An image that is shown.

    Args:
        image: linear radiance (H, W, 3).
        spp: samples of a pixel; 0 for a coarse image.
        error: relative standard error of the image before denoising; infinite where it is not known.
        seconds: that its passes took.
        ready: of these, those of the first: models made, light found.
        told: on light that was gathered or corrected, with its error.
    """

    image: np.ndarray
    spp: int
    error: float
    seconds: float
    ready: float
    told: tuple[str, ...]


class LiveScene:
    """A scene with edits. All of it is for one thread.

    An edit changes the scene in place where that is possible, so that integrators keep what they know of it, and
    loads it anew elsewhere. Images are those of the scene that `save` writes.

    Args:
        scene: the path of an XML file, or a dict as for `mitsuba.load_dict`.
        parameters: values of the parameters $name of an XML file.

    Attributes:
        up: the axis of the world that is up for the first sensor.
        centre: the middle of all objects.

    Raises:
        ValueError: as `open_scene`, or the scene has no sensor.
    """

    def __init__(self, scene: dict[str, Any] | str | Path, parameters: Mapping[str, str] | None = None) -> None:
        self.source, self._parameters = scene, dict(parameters or {})
        self.file = None if isinstance(scene, dict) else Path(scene).resolve()
        self.folder = Path.cwd() if self.file is None else self.file.parent
        self.edits, self._integrators = Edits(), {}
        self.scene = self._open(self.edits)
        check_sensor(self.scene, 0)
        up = np.array(self.camera(1).to_world)[:3, 1]
        axis, boxes = np.argmax(np.abs(up)), [shape.bbox() for shape in translucent_shapes(self.scene)]
        self.up = np.eye(3)[axis] * np.sign(up[axis])
        low, high = (np.array([np.array(end) for end in ends]) for ends in zip(*((box.min, box.max) for box in boxes)))
        self.centre = (low.min(axis=0) + high.max(axis=0)) / 2
        state, _ = parsed(scene, self._parameters)
        props = integrator_props(state)
        given = {} if props is None else {key: props[key] for key in props.keys() if key not in OF_MITSUBA}
        self._shared = {key: given[key] for key in SHARED if key in given}
        self.names = list(names_of(state))
        walks = is_bssrdf(self.scene.integrator()) is False
        light = "precomputed" if walks else "gathered"
        self.way = Way(PATH_TRACED if walks else str(given.get("model", "")), str(given.get("light", light)))
        self._written = self._time()

    # ---- what there is to choose

    def environments(self) -> list[str]:
        """Maps in the folder of the scene, and in folders of it, by their paths from there."""
        here = self.folder.resolve()
        files = sorted(path for path in here.rglob("*") if path.suffix.lower() in MAPS and path.is_file())
        return [path.relative_to(here).as_posix() for path in files if path.resolve().is_relative_to(here)]

    def medium(self, name: str) -> Medium:
        """The medium of an object as it is, 1/mm."""
        return self._surfaces()[name].spec.medium

    def _surfaces(self) -> dict[str, Any]:
        found = []
        for surface in map(surface_of, translucent_shapes(self.scene)):
            found += [surface] if all(surface is not each for each in found) else []
        return dict(zip(self.names, found))

    def camera(self, pixels: int) -> Camera:
        """The camera of the first sensor, with about so many pixels."""
        sensor = self.scene.sensors()[0]
        width, height = (int(v) for v in sensor.film().crop_size())
        parameters = mi.traverse(sensor)
        x_fov = float(parameters["x_fov"][0]) if "x_fov" in parameters else 40.0
        fov = math.degrees(2 * math.atan(math.tan(math.radians(x_fov) / 2) * height / width))
        scale = math.sqrt(pixels / (width * height))
        return Camera(
            _rows(sensor.world_transform().matrix), fov, max(round(scale * width), 1), max(round(scale * height), 1)
        )

    def stale(self) -> bool:
        """Whether the file has been written since it was read."""
        return self._time() != self._written

    def _time(self) -> int:
        return self.file.stat().st_mtime_ns if self.file is not None and self.file.exists() else 0

    # ---- edits

    def apply(self, edits: Edits) -> None:
        """Bring the scene to these edits; ValueError leaves it as it was."""
        if edits == self.edits:
            return
        if edits.environment and edits.environment not in self.environments():
            raise ValueError(f"environment must be a map in the folder of the scene, got {edits.environment!r}")
        fresh = self._open(edits)
        # kernels know the numbers of all objects that are there: those of one scene only are found again
        kept = _brought(self.scene, fresh)
        del fresh
        if not kept:
            self.scene, self._integrators = None, {}
        gc.collect()
        if not kept:
            self.scene = self._open(edits)
        self.edits = edits

    def _open(self, edits: Edits) -> mi.Scene:
        def changed(state: mi.parser.ParserState) -> None:
            if edits != Edits():
                change(state, edits, self._turned(edits))
            name_nodes(state)

        scene = open_scene(self.source, parameters=self._parameters, change=changed)
        put(scene, mi.traverse(scene), _of_light(scene))
        return scene

    def _turned(self, edits: Edits) -> np.ndarray:
        """The transformation of all light."""
        T = mi.ScalarAffineTransform4d
        turn = T().rotate(self.up, edits.turn) @ T().rotate(np.roll(self.up, 1), edits.tilt)
        return np.array((T().translate(self.centre) @ turn @ T().translate(-self.centre)).matrix)

    def save(self, name: str, way: Way, camera: Camera, edits: Edits) -> str:
        """Write the scene as it is into its folder, as a new file or over one that `save` has written.
        `name`: of the file, without folders. `way`: becomes its integrator. `camera`: becomes its first sensor.
        `edits`: what is changed. Returns the command that renders it. ValueError if the name has a folder, does not end
        in .xml, or is the one of the scene that is looked at; or that is a glTF file."""
        path = self.folder / name
        if Path(name).name != name or path.suffix != ".xml" or path == self.file:
            raise ValueError(f"name must be of a new .xml file beside the scene, without folders, got {name!r}")
        if is_gltf(self.source):
            raise ValueError(f"scene must be an XML file or a dict to be saved, got {str(self.source)!r}")
        state, _ = parsed(self.source, self._parameters)
        if edits != Edits():
            change(state, edits, self._turned(edits))
        put_integrator(state, way.plugin(self._shared))
        put_camera(state, camera)
        write_atomically(path, mi.parser.write_string(state).encode())
        return f"halfspace-sss render {path} --spp 64" + (" --denoise" if way.denoise else "")

    # ---- images

    def integrator(self, way: Way) -> mi.Integrator:
        """Made once for a way; it keeps what it knows of the scene until that is loaded anew."""
        if way not in self._integrators:
            self._integrators[way] = mi.load_dict(way.plugin(self._shared))
        return self._integrators[way]

    def passes(self, camera: Camera, way: Way, seed: int = 0) -> Iterator[Shown]:
        """Images of the scene as it is: a coarse one, then means of ever more passes.
        Work is cancelled by `halfspace_sss.interrupts.cancellable`, and then leaves what is known whole. ValueError if
        the integrator refuses the scene."""
        started, integrator, denoise = time.perf_counter(), self.integrator(way), None
        # the walks of a correction, and more light for walks, come after the first image
        coarse = image_of(integrator.preview, self.scene, camera.sensor(COARSE), seed, 1)
        ready = time.perf_counter() - started
        rows, columns = (np.arange(n) * m // n for n, m in zip((camera.height, camera.width), coarse.shape))
        yield Shown(coarse[rows][:, columns, :3], 0, math.inf, ready, ready, ())
        sensor, mean, spp, told, lit = camera.sensor(), None, 1, None, LIT
        while mean is None or mean.spp < MOST:
            begun, number, draw = time.perf_counter(), seeded(seed, mean.passes if mean else 0), integrator.render
            if not is_bssrdf(integrator):
                # light inside serves passes until there are twice as many samples, as it takes longer than a pass
                pixels, most = camera.width * camera.height, on_device(SAMPLES_OF_LIGHT)
                if mean is not None and mean.spp >= lit + min(lit, most / pixels):
                    lit = mean.spp
                    integrator.prepare(self.scene, ImageSamples(min(lit * pixels, most), pixels), number)
                draw = partial(integrator.preview, glints=True)
            image = image_of(draw, self.scene, sensor, number, spp)
            last = time.perf_counter() - begun
            mean = (mean or Reference.empty(image.shape, {})).add(image, spp, last)
            if told is None:
                told = tuple(integrator.gathered) if is_bssrdf(integrator) else ()
            shown = mean.mean[..., :3]
            if way.denoise:
                denoise = denoise or Denoiser(self.scene, sensor, integrator, GUIDE_SPP, clean=False)
                shown = denoise(mean.mean)
            yield Shown(shown, mean.spp, mean.relative_error, ready + mean.seconds, ready, told)
            spp = 2 * spp if last < BRIEF and SHARE * 2 * spp <= mean.spp else spp


def _rows(matrix: object) -> tuple[tuple[float, ...], ...]:
    """A matrix, of one Dr.Jit lane or none, as numbers that can be compared."""
    return tuple(map(tuple, np.array(matrix, dtype=float).reshape(4, 4).tolist()))


def image_of(draw: Callable, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int) -> np.ndarray:
    """An image of finite pixels, by a method of an integrator; ValueError says why a scene is refused."""
    try:
        return finite_pixels("the image", draw(scene, sensor, seed=seed, spp=spp))
    except RuntimeError as error:
        raise ValueError(first_cause(error)) from error


def _brought(scene: mi.Scene, wanted: mi.Scene) -> bool:
    """Change a scene in place to another of the same file, if it can be: the index of a boundary cannot."""
    keys = differing(scene, wanted)
    if keys is None or any(".boundary." in key for key in keys):
        return False
    put(scene, mi.traverse(wanted), keys)
    return True


def _of_light(scene: mi.Scene) -> list[str]:
    """Numbers and transformations of emitters."""
    parameters = mi.traverse(scene)

    emitters = {emitter.id() for emitter in scene.emitters() if emitter.get_shape() is None}
    lamps = {shape.id() for shape in scene.shapes() if shape.is_emitter()}

    def wanted(key: str) -> bool:
        (name, _, inner), value = key.partition("."), parameters[key]
        if inner == "to_world":
            return name in emitters | lamps
        numbers = dr.is_jit_v(value) and not dr.is_tensor_v(value) and dr.width(value) == 1
        return numbers and (name in emitters or name in lamps and inner.startswith("emitter."))

    return [key for key in parameters.keys() if wanted(key)]


# ---- What one who looks at it sees: images of what is wished for, one pass at a time, in words and bytes


class Wish(NamedTuple):
    """What is to be seen: the scene, how it is rendered and from where, stops of exposure, and a reference beside,
    on the right of a share of the width."""

    edits: Edits
    way: Way
    camera: Camera
    exposure: float = 0.0
    compare: bool = False
    split: float = 0.5


class Screen:
    """Renders a wish in passes and begins anew when it changes."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._wish: Wish | None = None
        self._runs: list[Iterator[Shown]] = []
        self._shown: list[Shown | None] = []

    def step(
        self, live: LiveScene, wish: Wish, outdated: Callable[[], bool]
    ) -> tuple[np.ndarray | None, str] | None:  # fmt: skip
        """One more pass: the picture (H, W, 3) in 8 bits and what is said of it, in Markdown; None if all is done.

        Work ends early, with None, when `outdated` says so. A scene that is refused gives no picture, but the reason.
        """
        before, self._wish = self._wish, wish
        try:
            with cancellable(outdated):
                if before is None or before[:3] != wish[:3] or before.compare != wish.compare:
                    self._runs = []
                    live.apply(wish.edits)
                    ways = [wish.way, *([Way(PATH_TRACED, "auto", wish.way.denoise)] if wish.compare else [])]
                    self._runs = [live.passes(wish.camera, way) for way in ways]
                    self._shown = [None] * len(ways)
                elif not self._runs and before == wish:
                    return None
                self._advance()
        except KeyboardInterrupt:
            self.restart()
            return None
        except (ValueError, RuntimeError, ImportError) as error:
            self._runs = []
            return None, f"**{' '.join(str(error).split())}**"
        return self._picture(wish)

    def _advance(self) -> None:
        """A pass of the image that has had less time."""
        spent = [shown.seconds if shown else -1.0 for shown in self._shown]
        for k in np.argsort(spent, kind="stable"):
            if k < len(self._runs) and (found := next(self._runs[k], None)) is not None:
                self._shown[k] = found
                return
        self._runs = []

    def _picture(self, wish: Wish) -> tuple[np.ndarray, str]:
        pictures = [srgb(np.maximum(shown.image, 0), wish.exposure) for shown in self._shown if shown]
        told = [_told(shown, "reference" if k else "") for k, shown in enumerate(self._shown) if shown]
        picture = pictures[0].copy()
        if len(pictures) > 1:
            column = round(wish.split * picture.shape[1])
            picture[:, column:] = pictures[1][:, column:]
            picture[:, column - 1 : column] = 1.0
            told.append(f"FLIP {flip_ldr(*reversed(pictures)).mean:.3f}, with the noise of both")
        return np.round(255 * picture).astype(np.uint8), "\n\n".join(told)


def _told(shown: Shown, name: str) -> str:
    """What is known of an image."""
    noise = f", noise {shown.error:.1%}" if math.isfinite(shown.error) else ""
    samples = f"{shown.spp} samples" if shown.spp else "coarse"
    time = f"{shown.seconds:.2f} s, light ready after {shown.ready:.2f} s"
    return "\n\n".join([f"{name} {samples}{noise}; {time}".strip(), *shown.told])
