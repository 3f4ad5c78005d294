"""Random scenes, made anew from a seed: shape x medium x light x size x tolerance, as Mitsuba files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.closed_shapes import SHAPES, SIZE, write_shape
from halfspace_sss.checks import check_count
from halfspace_sss.provenance import JsonDict, write_atomically

LIGHTS = ("sky", "lamp", "lamp and sky", "windows")
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

    def record(self) -> JsonDict:
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
        seed=seed, number=number, shape=str(rng.choice(SHAPES)), light=str(rng.choice(LIGHTS)),
        sigma_t=_digits(sigma_t), albedo=_digits(albedo), g=float(rng.choice([0.0, 0.0, 0.5, 0.8])),
        eta=float(rng.choice([1.0, 1.3, 1.3, 1.5])), mfp=round(mfp, 3), view=_digits(view / np.linalg.norm(view)),
        tolerance=drawn if tolerance is None else tolerance, images=int(rng.choice([1, 10, 100])),
    )  # fmt: skip


def _digits(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(f"{v:.6g}") for v in values)


def write_scene(scene: RandomScene, folder: Path) -> Path:
    """Write NAME.xml, its mesh NAME.ply and the map of its environment, if any; the path of the first."""
    file = folder / f"scene-{scene.seed}-{scene.number:03d}.xml"
    mesh = file.with_suffix(".ply")
    write_shape(mesh, scene.shape, (scene.seed, scene.number, 62))
    write_atomically(file, _xml(scene, mesh.name))
    if scene.light == "windows":
        write_atomically(folder / WINDOWS, _windows())
    return file


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
    <film type="hdrfilm"><integer name="width" value="{FILM}"/><integer name="height" value="{FILM}"/>
      <rfilter type="box"/></film>
  </sensor>
</scene>
"""
