"""The model and the fit of Deng et al. 2022: the albedo of a dipole as a texture, from photographs of known geometry.

With classic dipoles R_o and R_i of the media at exit and entry,

    S = (1 - F_o) sqrt(R_o(r) R_i(r)) (1 - F_i) / ((1 - 2 C_1(1/eta)) pi),

coefficients reduced (g = 0), no single scattering. This is `standard_dipole_normalized` under textures, whose
A = (1 + F_dr)/(1 - F_dr) is that of the published fit of F_dr = 2 C_1(eta): 0.2 % at most from eta 1.3 to 1.5.

Loss: the product of the residuals of two renders, and 0.01 of the total variation of the albedo. Adam (0.9, 0.999),
rates 0.05 of the albedo and of ln sigma_t, times 0.95 each 1000 steps, one photograph a step. The albedo has
texels of neighbouring vertices, sigma_t one value a channel. Left out: their fit of the roughness and of eta; the
penalty of the range of sigma_t, which their code applies to its logarithm; and their sampling, for that of `bssrdf`. As
they take 10 000 steps, and drafts few, the rates fall to 0 by a cosine besides. The albedo moves by sqrt(1 - albedo):
its own derivatives have no bound near 1, and one of them stops Adam there for a thousand steps.

Source: Deng, Luan, Walter, Bala and Marschner: Reconstructing Translucent Objects Using Differentiable Rendering,
SIGGRAPH 2022, and their code.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from benchmarks.published.photographs import Studio
from figures.parts.part import SceneDict
from full_geometry.geometry.mesh import face_vertices, vertex_positions
from halfspace_sss.progress import Progress

MODEL, ORDERS = "standard_dipole_normalized", "multiple"
START = (0.95, 1.0)  # albedo and sigma_t, 1/mm
RATE, FALL, EACH = 0.05, 0.95, 1000
VARIATION = 0.01  # weight of the total variation
BOUNDS = (0.01, 0.995)  # of sqrt(1 - albedo)
SMALLEST, LARGEST = 0.02, 50.0  # of sigma_t, 1/mm
ALBEDO = "vertex_albedo"


@dataclass(frozen=True, eq=False)
class DengTextures:
    """What was found: albedo of each vertex (n, 3), and sigma_t of each channel, 1/mm."""

    albedo: np.ndarray
    sigma_t: np.ndarray


def painted(
    part: SceneDict, path: Path, eta: float, textures: DengTextures | None = None, reflection: bool = True
) -> SceneDict:
    """A mesh from a file as the model has it, with its textures; without them those of the start.

    Args:
        part: of a scene, with the file of the mesh.
        path: where the mesh with the attribute `ALBEDO` is written.
        eta: relative index.
        textures: of its vertices.
        reflection: whether its boundary reflects.
    """
    mesh = mi.load_dict({"type": "ply", "filename": part["filename"]})
    if textures is None:
        textures = DengTextures(np.full((mesh.vertex_count(), 3), START[0]), np.full(3, START[1]))
    mesh.add_attribute(ALBEDO, 3, np.ascontiguousarray(textures.albedo, dtype=np.float32).ravel())
    mesh.write_ply(str(path))
    surface = {"type": "translucent", "model": MODEL, "orders": ORDERS, "g": 0.0, "eta": eta, "reflection": reflection}
    surface |= {"albedo": {"type": "mesh_attribute", "name": ALBEDO}}
    surface |= {"sigma_t": ", ".join(f"{v:.9g}" for v in textures.sigma_t)}
    return {"type": "ply", "filename": str(path), "bsdf": surface}


def fit(
    studio: Studio, images: np.ndarray, *, texels: int, steps: int, spp: int, seed: int = 0,
    progress: Progress | None = None,
) -> DengTextures:  # fmt: skip
    """Textures of the object of a studio from its photographs.

    Args:
        studio: where they were taken, with the object as `painted` makes it.
        images: of all its poses (n, size, size, 3).
        texels: of the albedo: so many vertices, each with those that are nearest to it; all of them if there are fewer.
        steps: of Adam.
        spp: samples a pixel of each of both renders.
        seed: of the order of photographs and of all samples.
    """
    parameters, of = studio.parameters, studio.shape.id()
    keys = {"albedo": f"{of}.{ALBEDO}", "log_sigma_t": f"{of}.bsdf.sigma_t"}
    first, second = (mi.UInt32(end) for end in _edges(studio.shape))
    rng = np.random.default_rng([seed, 11])
    texel = mi.UInt32((3 * _texels(studio.shape, texels, rng)[:, None] + np.arange(3)).ravel().astype(np.uint32))
    scale = 1 / float(images[images > 0].mean())
    optimiser = mi.ad.Adam(lr=RATE, beta_1=0.9, beta_2=0.999)
    optimiser["s"] = dr.full(mi.Float, np.sqrt(1 - START[0]), 3 * min(texels, studio.shape.vertex_count()))
    optimiser["log_sigma_t"] = dr.log(mi.Spectrum(parameters[keys["log_sigma_t"]]))
    for k in range(steps):
        optimiser.set_learning_rate(RATE * FALL ** (k / EACH) * (1 + np.cos(np.pi * k / steps)) / 2)
        which = int(rng.integers(len(images)))
        studio.set_up(which)
        albedo = 1 - dr.square(dr.gather(mi.Float, optimiser["s"], texel))
        parameters[keys["albedo"]], parameters[keys["log_sigma_t"]] = albedo, dr.exp(optimiser["log_sigma_t"])
        parameters.update()
        seeds = np.random.SeedSequence([seed, k]).generate_state(2)
        image = mi.render(studio.scene, parameters, spp=spp, seed=int(seeds[0]), seed_grad=int(seeds[1]))
        # derivatives come from the other render: the gradient of the product of both residuals
        residual = scale * (image - mi.TensorXf(images[which].astype(np.float32)))
        variation = dr.mean(dr.abs(dr.gather(mi.Float, albedo, first) - dr.gather(mi.Float, albedo, second)))
        dr.backward(dr.mean(dr.square(residual), axis=None) + VARIATION * variation)
        optimiser.step()
        optimiser["s"] = dr.clip(optimiser["s"], *BOUNDS)
        optimiser["log_sigma_t"] = dr.clip(optimiser["log_sigma_t"], *(float(np.log(v)) for v in (SMALLEST, LARGEST)))
        if progress is not None:
            progress(k + 1, steps)
    s = np.array(dr.gather(mi.Float, dr.detach(optimiser["s"]), texel)).reshape(-1, 3)
    return DengTextures(1 - s * s, np.exp(np.ravel(np.array(dr.detach(optimiser["log_sigma_t"])))))


def _texels(mesh: mi.Mesh, n: int, rng: np.random.Generator) -> np.ndarray:
    """The number of the texel of each vertex."""
    points = vertex_positions(mesh)
    return cKDTree(points[rng.permutation(len(points))[:n]]).query(points)[1]


def _edges(mesh: mi.Mesh) -> np.ndarray:
    """The numbers of the attribute at both ends of each edge of the faces, (2, 9 faces)."""
    faces = face_vertices(mesh)
    ends = np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()])
    return (3 * ends[..., None] + np.arange(3)).reshape(2, -1).astype(np.uint32)
