"""The modelled objects: media on grids from shares of tissues, and the objects as dicts for Mitsuba, in mm.

The candle has burnt down to a bowl with a pool of molten wax, its wick and flame; one homogeneous wax throughout. It is
56 mm wide, about 65 mm tall; the pool stands at 40 mm, the flame, 11 mm tall and 4.4 mm wide, in the bowl above it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.modelling import varying
from benchmarks.modelling.meshes import (
    Box,
    Mesh,
    capsule,
    cut,
    fbm,
    in_chunks,
    join,
    length,
    noise,
    overlap,
    ring_noise,
    smoothstep,
    surface,
)
from figures.parts.part import SceneDict
from halfspace_sss.checks import check_choice
from halfspace_sss.materials.files import parse
from halfspace_sss.materials.material import Material
from halfspace_sss.provenance import write_atomically

BOX = Box((-33.0, -1.0, -33.0), (33.0, 71.0, 33.0))
RADIUS, HEIGHT, POOL = 28.0, 64.0, 40.0
BOWL = 22.5  # radius at the rim
DIP, DIP_ANGLE = 9.0, 1.35  # of the rim where it has slumped, mm and azimuth from x towards z
WICK = ((0.0, POOL + 0.15, 0.0), (0.3, POOL + 3.5, 0.2), (1.1, POOL + 6.0, 0.5))
FLAME = (0.6, POOL + 8.7, 0.3)  # centre of its widest part
FLAME_FOOT = 2.8  # below it
FLAME_BOX = Box((-3.0, POOL + 4.0, -3.0), (4.2, POOL + 19.0, 3.6))
FLAME_CELLS = 40


@dataclass(frozen=True, eq=False)
class Candle:
    """The wax, the wick and the flame, three closed meshes that do not touch."""

    wax: Mesh
    wick: Mesh
    flame: Mesh


def make_candle(resolution: int = 160, seed: int = 0) -> Candle:
    """The candle.
    `resolution`: grid cubes along its height, >= 8; that of wick and flame is fixed. `seed`: of the drips and the
    unevenness of rim and side. ValueError if the resolution is too small."""
    drips = _drips(seed)
    wax = surface(lambda p: wax_distance(p, seed, drips), BOX, resolution)
    box = Box((-1.5, POOL - 1.0, -1.5), (2.5, POOL + 8.0, 2.0))
    return Candle(wax, surface(wick_distance, box, FLAME_CELLS), surface(flame_distance, FLAME_BOX, FLAME_CELLS))


def wick_distance(p: np.ndarray) -> np.ndarray:
    """A bent rod that ends just above the pool."""
    a, b, c = (np.array(v) for v in WICK)
    a = a + (0, 0.7, 0)
    return join(capsule(p, a, b, 0.7, 0.65), capsule(p, b, c, 0.65, 0.5), 0.2)


def flame_distance(p: np.ndarray) -> np.ndarray:
    """A drop with the tip upwards: its radius is that of a ball at the foot and falls to nothing at the tip."""
    x, y, z = np.moveaxis(p - np.array(FLAME), -1, 0)
    t = np.clip(y / 9.0, -1, 1)
    lean = 0.5 * np.maximum(t, 0) ** 2
    wide = np.where(
        t < 0, np.sqrt(np.clip(1 - (y / FLAME_FOOT) ** 2, 0, 1)), (1 - np.maximum(t, 0) ** 1.6) ** 1.35 * (1 + 0.25 * t)
    )
    beyond = np.maximum(np.maximum(y - 9.0, -FLAME_FOOT - y), 0)
    return 0.5 * (length(x - lean, z, beyond) - 2.2 * wide)


def wax_distance(p: np.ndarray, seed: int, drips: list[tuple]) -> np.ndarray:
    """The pillar, less its bowl, with drips down the side."""
    x, y, z = np.moveaxis(p, -1, 0)
    angle = np.arctan2(z, x)
    off = np.angle(np.exp(1j * (angle - DIP_ANGLE)))
    rim = 1.6 * ring_noise(angle, seed) - DIP * np.exp(-((off / 0.75) ** 2))
    lift = y - rim * smoothstep(POOL - 8, HEIGHT, y)
    rho = length(x, z) - 0.5 * ring_noise(angle, seed + 1) * smoothstep(0, HEIGHT, y)
    side = rho - RADIUS - 0.25 * noise(p / 17, seed + 2)
    result = overlap(side, np.abs(lift - HEIGHT / 2) - HEIGHT / 2, 4.0)
    result = join(result, _rod_field(p, drips), 2.2)
    return cut(result, _bowl(rho, angle, lift, y, seed), 3.5) + 0.06 * fbm(p / 6, seed + 3, 2) * (lift > POOL + 2)


def _bowl(rho: np.ndarray, angle: np.ndarray, lift: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """What is burnt away: flat over the pool, wider towards the rim, rounded where they meet."""
    wide = BOWL - 3.0 + 3.4 * smoothstep(POOL, HEIGHT + 4, lift) + 0.8 * ring_noise(angle, seed + 4)
    return overlap(rho - wide, POOL - y, 4.0)


def _drips(seed: int) -> list[tuple]:
    """Runs of wax over the rim: bent rods that start flat and end in a bead, as (points, radii)."""
    rng, results = np.random.default_rng([seed, 3]), []
    angles = DIP_ANGLE + np.array([0.1, -0.42, 0.58, -0.7, 2.4, 3.5, -1.7]) + rng.uniform(-0.1, 0.1, 7)
    for angle in angles:
        off = np.angle(np.exp(1j * (angle - DIP_ANGLE)))
        top = HEIGHT - DIP * np.exp(-((off / 0.75) ** 2)) - 2.0
        reach, thick = min(rng.uniform(12, 42), top - 9), rng.uniform(1.1, 1.9)
        t = np.array([0, 0.06, 0.2, 0.4, 0.6, 0.8, 0.93, 1.0])
        ways = angle + np.concatenate([[0, 0], np.cumsum(rng.normal(0, 0.018, 6))])
        out = RADIUS + thick * np.array([-2.2, -0.75, -0.45, -0.35, -0.3, -0.3, -0.25, -0.25])
        points = np.stack([out * np.cos(ways), top - t * reach, out * np.sin(ways)], axis=1)
        results.append((points, thick * np.array([1.6, 1.15, 0.95, 0.85, 0.8, 0.85, 1.2, 1.35])))
    return results


def _rod_field(p: np.ndarray, rods: list[tuple]) -> np.ndarray:
    result = np.full(p.shape[:-1], np.inf)
    for points, radii in rods:
        for a, b, r, s in zip(points[:-1], points[1:], radii[:-1], radii[1:]):
            result = np.minimum(result, capsule(p, a, b, r, s))
    return result


TISSUES = Path(__file__).with_name("tissues.toml")

Tissues = Callable[[np.ndarray], Mapping[str, np.ndarray]]


@functools.cache
def _tissues() -> dict[str, Material]:
    return {material.name: material for material in parse(TISSUES.read_text(encoding="utf-8"), TISSUES.name)}


def tissue(name: str) -> Material:
    """What an object is made of, with its source; ValueError if there is none of that name."""
    check_choice("tissue", name, _tissues())
    return _tissues()[name]


@dataclass(frozen=True, eq=False)
class Grid:
    """A medium on the cells of a box; g = 0. `sigma_t`: (nz, ny, nx), 1/mm, > 0: extinction, the same in all channels.
    `albedo`: (nz, ny, nx, 3), in [0, 1]. `box`: that the cells fill, mm; values belong to their middles. ValueError if
    the shapes do not match or a value is out of range."""

    sigma_t: np.ndarray
    albedo: np.ndarray
    box: Box

    def __post_init__(self) -> None:
        if self.sigma_t.ndim != 3 or self.albedo.shape != (*self.sigma_t.shape, 3):
            got = f"{self.sigma_t.shape} and {self.albedo.shape}"
            raise ValueError(f"sigma_t and albedo must have the shapes (nz, ny, nx) and (nz, ny, nx, 3), got {got}")
        if not (np.isfinite(self.sigma_t).all() and self.sigma_t.min() > 0):
            raise ValueError(f"sigma_t must be finite and > 0, got {self.sigma_t.min()}")
        if not (self.albedo.min() >= 0 and self.albedo.max() <= 1):
            raise ValueError(f"albedo must be in [0, 1], got {self.albedo.min()} to {self.albedo.max()}")

    def volumes(self) -> SceneDict:
        """Grid volumes of Mitsuba, by name: "sigma_t" with one channel, "albedo" with three."""
        import mitsuba as mi

        arrays = {"sigma_t": self.sigma_t[..., None], "albedo": self.albedo}
        return {name: mi.VolumeGrid(np.ascontiguousarray(v, dtype=np.float32)) for name, v in arrays.items()}

    def write(self, folder: Path, name: str) -> SceneDict:
        """Write FOLDER/NAME_sigma_t.vol and ..._albedo.vol, and return the volumes that read them, by name."""
        import mitsuba as mi

        low, high = np.array(self.box.low), np.array(self.box.high)
        to_world = mi.ScalarTransform4f().translate(low.tolist()).scale((high - low).tolist())
        volumes = {}
        for key, volume in self.volumes().items():
            path, stream = Path(folder) / f"{name}_{key}.vol", mi.MemoryStream()
            volume.write(stream)
            write_atomically(path, bytes(stream.raw_buffer()))
            volumes[key] = {"type": "gridvolume", "filename": str(path), "to_world": to_world}
        return volumes


def mixed(tissues: Tissues, box: Box, resolution: int) -> Grid:
    """The medium of shares f_k of tissues: sigma_t = sum f_k sigma_t,k; albedo = sum f_k sigma_t,k albedo_k / sigma_t.
    `tissues`: of points (n, 3), mm: share of each tissue by name, >= 0, summing to 1. `box`: that is covered; the
    grid's box is larger by less than a cell. `resolution`: cells along the longest side, >= 8. ValueError if the
    resolution is too small, there is no such tissue, or shares are out of range."""
    cell = box.cell(resolution)
    counts = box.counts(cell)
    high = tuple(float(low + cell * n) for low, n in zip(box.low, counts))
    x, y, z = (low + cell * (np.arange(n) + 0.5) for low, n in zip(box.low, counts))
    points = np.stack(np.broadcast_arrays(x[None, None], y[None, :, None], z[:, None, None]), axis=-1).reshape(-1, 3)
    result = in_chunks(lambda p: _coefficients(tissues(p)), points).astype(np.float32)
    sigma_t, sigma_s = result[:, 0], result[:, 1:]
    shape = tuple(counts[::-1])
    albedo = np.minimum(sigma_s / sigma_t[:, None], 1)
    return Grid(sigma_t.reshape(shape), albedo.reshape(*shape, 3), Box(box.low, high))


def _coefficients(shares: Mapping[str, np.ndarray]) -> np.ndarray:
    """sigma_t and sigma_s of each channel, (n, 4)."""
    total = sum(shares.values())
    if min(v.min() for v in shares.values()) < -1e-6 or np.abs(total - 1).max() > 1e-6:
        raise ValueError(f"shares of tissues must be >= 0 and sum to 1, got sums up to {float(total.max())!r}")
    media = {name: tissue(name).medium for name in shares}
    columns = [[m.sigma_t[0], *m.sigma_s] for m in media.values()]
    return np.stack(list(shares.values()), axis=1) @ np.array(columns)


FLAME_RADIANCE = (60.0, 30.0, 8.5)
MODELS: dict[str, tuple[Callable, Box, float]] = {  # of varying objects, of a seed; box; relative index
    "mandarin": (varying.Mandarin, varying.MANDARIN_BOX, 1.36),
    "croissant": (varying.Croissant, varying.CROISSANT_BOX, 1.3),
}


@dataclass(frozen=True, eq=False)
class Varying:
    """An object whose medium varies: its surface, the medium, the relative index of its boundary."""

    name: str
    mesh: Mesh
    grid: Grid
    eta: float


def make_varying(name: str, resolution: int = 192, grid_resolution: int = 160, seed: int = 0) -> Varying:
    """An object whose medium varies.
    `name`: in `MODELS`. `resolution`: grid cubes of the surface along the longest side of its
    box, >= 8. `grid_resolution`: cells of the medium along that side, >= 8. `seed`: of everything uneven about it.
    ValueError if there is no such object, or a resolution is too small."""
    check_choice("object", name, MODELS)
    make, box, eta = MODELS[name]
    result = make(seed)
    mesh, grid = surface(result.distance, box, resolution), mixed(result.tissues, box, grid_resolution)
    return Varying(name, mesh, grid, eta)


def candle_parts(folder: Path, resolution: int = 192, seed: int = 0) -> SceneDict:
    """The candle: "candle" with the surface `translucent`, "wick", and "flame", an area light in the bowl; mm.
    `folder`: where its PLY files are written. `resolution`, `seed`: as for `make_candle`."""
    made, wax = make_candle(resolution, seed), tissue("candle wax").medium
    files = {name: getattr(made, name).write_ply(Path(folder) / f"{name}.ply") for name in ("wax", "wick", "flame")}
    surface = {
        "type": "translucent",
        "model": "neural",
        "g": 0.0,
        "eta": wax.eta,
    }  # smooth, so that walks join the flame
    for key in ("sigma_s", "sigma_a"):
        surface[key] = ", ".join(f"{v:.9g}" for v in getattr(wax, key))
    black = {"type": "diffuse", "reflectance": 0.0}
    soot = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.02, 0.015, 0.012]}}
    glow = {"type": "area", "radiance": {"type": "rgb", "value": list(FLAME_RADIANCE)}}
    return {
        "candle": {"type": "ply", "filename": str(files["wax"]), "bsdf": surface},
        "wick": {"type": "ply", "filename": str(files["wick"]), "bsdf": soot},
        "flame": {"type": "ply", "filename": str(files["flame"]), "bsdf": black, "emitter": glow},
    }


def learnable_parts(result: Varying, folder: Path) -> SceneDict:
    """An object whose medium varies with the surface `translucent` and a smooth boundary, so that it can be learnt; mm.
    `folder`: where its PLY file and its grid volumes are written."""
    path = result.mesh.write_ply(Path(folder) / f"{result.name}.ply")
    grids = result.grid.write(Path(folder), result.name)
    surface = {"type": "translucent", "model": "neural", "g": 0.0, "eta": result.eta, **grids}
    return {result.name: {"type": "ply", "filename": str(path), "bsdf": surface}}
