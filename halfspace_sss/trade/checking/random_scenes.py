"""Random scenes, made anew from a seed: shape x medium x light x size x tolerance, as Mitsuba files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from halfspace_sss.checks import check_count
from halfspace_sss.provenance import write_atomically

SHAPES = ("ball", "blob", "slab", "ring", "spikes")
LIGHTS = ("sky", "lamp", "lamp and sky", "windows")
SIZE = 100.0  # mm across; sizes in mean free paths come by sigma_t
COLUMNS, ROWS = 96, 48  # of the mesh
FILM = 512
WINDOWS = "windows.pfm"  # an environment map


@dataclass(frozen=True)
class RandomScene:
    """What tells one scene from another.

    Attributes:
        seed, number: that it was drawn by.
        shape, light: of `SHAPES` and `LIGHTS`.
        sigma_t: of each channel, 1/mm. albedo: likewise. g, eta: of all.
        mfp: mean free paths across, of the middle channel.
        view: direction of the camera.
        tolerance, images: of the job.
    """

    seed: int
    number: int
    shape: str
    light: str
    sigma_t: tuple[float, ...]
    albedo: tuple[float, ...]
    g: float
    eta: float
    mfp: float
    view: tuple[float, ...]
    tolerance: float
    images: int

    def record(self) -> dict[str, Any]:
        """Ready for JSON."""
        return asdict(self)


def random_scene(number: int, seed: int = 0, tolerance: float | None = None) -> RandomScene:
    """The scene of a number, whatever others are drawn.

    Sizes are 2 to 1000 mean free paths, 1 - albedo is log-uniform from 2e-4 to 0.7, tolerances from 0.03 to 0.3 unless
    one is given.
    """
    check_count("number", number, 0)
    check_count("seed", seed, 0)
    rng = np.random.default_rng([seed, number, 61])
    mfp = float(10 ** rng.uniform(np.log10(2), 3))
    sigma_t = mfp / SIZE * 10 ** rng.uniform(-0.2, 0.2, 3)
    sigma_t[1] = mfp / SIZE
    albedo = 1 - 10 ** np.clip(rng.uniform(np.log10(2e-4), np.log10(0.7)) + rng.uniform(-0.5, 0.5, 3), -3.7, -0.15)
    view = rng.standard_normal(3) * (1, 0.4, 1) + (0, 0.5, 0)
    drawn = float(f"{10 ** rng.uniform(np.log10(0.03), np.log10(0.3)):.3g}")
    return RandomScene(
        seed, number, str(rng.choice(SHAPES)), str(rng.choice(LIGHTS)), _digits(sigma_t), _digits(albedo),
        float(rng.choice([0.0, 0.0, 0.5, 0.8])), float(rng.choice([1.0, 1.3, 1.3, 1.5])), round(mfp, 3),
        _digits(view / np.linalg.norm(view)), drawn if tolerance is None else tolerance, int(rng.choice([1, 10, 100])),
    )  # fmt: skip


def _digits(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(f"{v:.6g}") for v in values)


def write_scene(scene: RandomScene, folder: Path) -> Path:
    """Write NAME.xml, its mesh NAME.ply and the map of its environment, if any; the path of the first."""
    mesh = mesh_file(scene, folder)
    file = mesh.with_suffix(".xml")
    write_atomically(file, _xml(scene, mesh.name))
    if scene.light == "windows":
        write_atomically(folder / WINDOWS, _windows())
    return file


def mesh_file(scene: RandomScene, folder: Path) -> Path:
    """Write the mesh alone, NAME.ply; its path."""
    path = folder / f"scene-{scene.seed}-{scene.number:03d}.ply"
    write_atomically(path, _ply(*_mesh(scene)))
    return path


def _mesh(scene: RandomScene) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, mm, and outward faces of a closed surface, SIZE across."""
    rng = np.random.default_rng([scene.seed, scene.number, 62])
    v, faces = _torus() if scene.shape == "ring" else _globe()
    if scene.shape == "blob":
        v = v * (1 + _waves(v, rng, 3.0, 0.35))[:, None]
    if scene.shape == "spikes":
        v = v * np.exp(_waves(v, rng, 6.0, 0.6))[:, None]
    if scene.shape == "slab":
        v = np.sign(v) * np.abs(v) ** 0.35 * np.array([1.0, 0.7, rng.uniform(0.06, 0.2)])
    size = np.linalg.norm(np.ptp(v, axis=0))
    return SIZE / size * (v - 0.5 * (v.min(0) + v.max(0))), faces


def _waves(v: np.ndarray, rng: np.random.Generator, frequency: float, height: float) -> np.ndarray:
    """A smooth random function of directions, at most `height`."""
    k, phase = rng.standard_normal((8, 3)) * frequency / 1.7, rng.uniform(0, 2 * np.pi, 8)
    return height * np.cos(v @ k.T + phase).mean(axis=1) * 1.5


def _globe() -> tuple[np.ndarray, np.ndarray]:
    theta = np.linspace(0, np.pi, ROWS + 1)[1:-1]
    phi = np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    x = np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)
    rings = np.stack([*x, np.broadcast_to(np.cos(theta)[:, None], x[0].shape)], axis=-1).reshape(-1, 3)
    v = np.concatenate([rings, [[0, 0, 1], [0, 0, -1]]])
    north, south, n = len(v) - 2, len(v) - 1, len(theta)
    j = np.arange(COLUMNS)
    right = (j + 1) % COLUMNS
    top = np.stack([np.full(COLUMNS, north), j, right], axis=1)
    low = (n - 1) * COLUMNS
    bottom = np.stack([np.full(COLUMNS, south), low + right, low + j], axis=1)
    return v, np.concatenate([top, _quads(n - 1, COLUMNS, wrap=False), bottom])


def _torus() -> tuple[np.ndarray, np.ndarray]:
    a, b = np.arange(ROWS) / ROWS * 2 * np.pi, np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    rho = 1 + 0.3 * np.cos(a)[:, None]
    v = np.stack([rho * np.cos(b), rho * np.sin(b), np.broadcast_to(-0.3 * np.sin(a)[:, None], (ROWS, COLUMNS))], -1)
    return v.reshape(-1, 3), _quads(ROWS, COLUMNS, wrap=True)


def _quads(rows: int, columns: int, wrap: bool) -> np.ndarray:
    """Two triangles for each cell of a grid whose columns close."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    below = (i + 1) % rows if wrap else i + 1
    right = (j + 1) % columns
    a, b, c, d = i * columns + j, below * columns + j, below * columns + right, i * columns + right
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _ply(v: np.ndarray, faces: np.ndarray) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(v)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.zeros(len(faces), dtype=[("n", "u1"), ("index", "<i4", 3)])
    rows["n"], rows["index"] = 3, faces
    return head.encode() + v.astype("<f4").tobytes() + rows.tobytes()


def _windows(height: int = 64) -> bytes:
    """A dim room with two windows, radiance from all directions as a PFM file."""
    theta, phi = (np.arange(height) + 0.5) / height * np.pi, (np.arange(2 * height) + 0.5) / height * np.pi
    image = np.full((height, 2 * height, 3), 0.15, dtype="<f4")
    for at, size, radiance in (((1.0, 5.2), (0.35, 0.45), (6.4, 6.6, 7.0)), ((1.2, 2.2), (0.5, 0.25), (3.0, 2.8, 2.4))):
        inside = (abs(theta - at[0]) < size[0])[:, None] & (abs(phi - at[1]) < size[1])
        image[inside] = radiance
    return f"PF\n{2 * height} {height}\n-1.0\n".encode() + image[::-1].tobytes()  # from the lowest row up


def _xml(scene: RandomScene, mesh: str) -> str:
    numbers = {key: ", ".join(f"{v:.6g}" for v in getattr(scene, key)) for key in ("sigma_t", "albedo")}
    origin = ", ".join(f"{2.2 * SIZE * v:.6g}" for v in scene.view)
    sky = '  <emitter type="constant"><rgb name="radiance" value="{0}"/></emitter>\n'
    lamp = (
        '  <shape type="sphere"><float name="radius" value="12"/><point name="center" value="90, 150, -60"/>\n'
        '    <emitter type="area"><rgb name="radiance" value="60, 57, 52"/></emitter></shape>\n'
    )
    lights = {"sky": sky.format("1"), "lamp": lamp, "lamp and sky": lamp + sky.format("0.4, 0.45, 0.5")}
    lights["windows"] = f'  <emitter type="envmap"><string name="filename" value="{WINDOWS}"/></emitter>\n'
    return f"""<scene version="3.0.0">
  <integrator type="bssrdf"><boolean name="hide_emitters" value="true"/></integrator>
{lights[scene.light]}  <shape type="ply" id="object"><string name="filename" value="{mesh}"/>
    <bsdf type="translucent"><string name="sigma_t" value="{numbers["sigma_t"]}"/>
      <string name="albedo" value="{numbers["albedo"]}"/>
      <float name="g" value="{scene.g}"/><float name="eta" value="{scene.eta}"/></bsdf>
  </shape>
  <sensor type="perspective"><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="{origin}" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="{FILM}"/><integer name="height" value="{FILM}"/></film>
  </sensor>
</scene>
"""
