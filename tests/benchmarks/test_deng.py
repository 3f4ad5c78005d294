"""The dipole of Deng et al. 2022 is its formula, and its fit finds what it has rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")
pytest.importorskip("igl")

from benchmarks.published import deng  # noqa: E402
from benchmarks.published.photographs import Poses, Studio, lobe  # noqa: E402
from full_geometry.geometry.points import SurfacePoint  # noqa: E402
from full_geometry.objects.objects import TranslucentObject  # noqa: E402
from full_geometry.settings import Settings  # noqa: E402
from full_geometry.transport.prepare import make_objects  # noqa: E402
from halfspace_sss.physics.fresnel import C_1, F_t  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")

ETA = 1.4
GREEN, RED = (0.6, 0.95, 0.5), (0.98, 0.7, 0.4)
SIGMA_T = (1.0, 1.5, 2.0)


def ball(folder: Path) -> Path:
    """A sphere of 3 mm as triangles."""
    corners = np.array([[s, 0, 0] for s in (-1, 1)] + [[0, s, 0] for s in (-1, 1)] + [[0, 0, s] for s in (-1, 1)])
    triangles = [corners[[a, b, c]] for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    for _ in range(3):
        middles = [[(t[i] + t[(i + 1) % 3]) / 2 for i in range(3)] for t in triangles]
        triangles = [np.array(f) for t, (p, q, r) in zip(triangles, middles)
                     for f in ((t[0], p, r), (p, t[1], q), (r, q, t[2]), (p, q, r))]  # fmt: skip
    triangles = [t[::-1] if np.linalg.det(t) < 0 else t for t in triangles]
    points, faces = np.unique(np.round(np.concatenate(triangles), 9), axis=0, return_inverse=True)
    points = 3 * points / np.linalg.norm(points, axis=1, keepdims=True)
    mesh = mi.Mesh("ball", len(points), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(points.ravel())
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters.update()
    mesh.write_ply(str(folder / "ball.ply"))
    return folder / "ball.ply"


def halves(path: Path) -> deng.DengTextures:
    """One colour above, another below."""
    up = np.array(mi.traverse(mi.load_dict({"type": "ply", "filename": str(path)}))["vertex_positions"])[1::3] > 0
    return deng.DengTextures(np.where(up[:, None], GREEN, RED), np.array(SIGMA_T))


def dipole(r: np.ndarray, albedo: float, sigma_t: float) -> np.ndarray:
    """R of Jensen et al. 2001 with F_dr = 2 C_1(eta)."""
    sigma_tr = sigma_t * np.sqrt(3 * (1 - albedo))
    z_r, result = 1 / sigma_t, 0.0
    z_v = z_r + 4 * (1 + 2 * C_1(ETA)) / (1 - 2 * C_1(ETA)) / (3 * sigma_t)
    for z in (z_r, z_v):
        d = np.sqrt(r * r + z * z)
        result = result + albedo / (4 * np.pi) * z * (1 + sigma_tr * d) * np.exp(-sigma_tr * d) / d**3
    return result


def test_the_model_of_deng_is_the_geometric_mean_of_dipoles_at_both_ends(tmp_path: Path) -> None:
    path = ball(tmp_path)
    part = deng.painted({"filename": str(path)}, tmp_path / "painted.ply", ETA, halves(path))
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "bssrdf"}, "ball": part})
    (obj,) = make_objects(scene, Settings())
    exits, entries = (obj.random_places(generator(mi, 512, pass_seed(1, k))) for k in range(2))
    y = [np.array(at.p)[1] for at in (exits, entries)]
    ends = [_known(obj, at) for at in (exits, entries)]
    found = np.array(obj.transport.S(*ends))
    kept = np.minimum(*np.abs(y)) > 0.6  # all corners of a face are of one colour
    assert kept.sum() > 200
    r = np.linalg.norm(np.array(exits.p) - np.array(entries.p), axis=0)
    F = F_t(np.array(ends[0].mu, dtype=float), ETA) * F_t(np.array(ends[1].mu, dtype=float), ETA)
    for c in range(3):
        R = [dipole(r, np.where(up > 0, GREEN[c], RED[c]), SIGMA_T[c]) for up in y]
        wanted = F * np.sqrt(R[0] * R[1]) / ((1 - 2 * C_1(1 / ETA)) * np.pi)
        np.testing.assert_allclose(found[c][kept], wanted[kept], rtol=0.015)


def _known(obj: TranslucentObject, at: SurfacePoint) -> SurfacePoint:
    """With the medium there, of the face that a ray meets."""
    si = obj.geometry.scene.ray_intersect(mi.Ray3f(at.p + at.n, -at.n))
    return at._replace(medium=obj.textured.at(si))


@pytest.mark.slow
def test_the_fit_of_deng_finds_two_colours_in_photographs_that_its_model_has_made(tmp_path: Path) -> None:
    path = ball(tmp_path)
    truth, part = halves(path), {"filename": str(path)}
    painted = [deng.painted(part, tmp_path / f"{k}.ply", ETA, t, reflection=False) for k, t in ((0, truth), (1, None))]
    made, blank = (Studio({"ball": p}, "ball", 16, 12, 3, deng.MODEL) for p in painted)
    found = deng.fit(blank, made.photographs(64, 5), texels=1000, steps=25, spp=16)
    up = truth.albedo[:, 0] == GREEN[0]
    errors = [np.abs(a - truth.albedo).mean() for a in (np.full(3, deng.START[0]), found.albedo)]
    assert errors[1] < 0.7 * errors[0]
    assert found.albedo[up, 0].mean() < found.albedo[~up, 0].mean() - 0.1
    assert found.albedo[~up, 1].mean() < found.albedo[up, 1].mean() - 0.1


def test_lobes_of_photographs_have_irradiance_one_and_look_where_poses_say() -> None:
    import full_geometry

    full_geometry.register()
    studio = Studio({"ball": {"type": "sphere", "bsdf": {"type": "translucent", "albedo": "0.5", "sigma_t": "9"}}},
                    "ball", 8, 3, 0)  # fmt: skip
    theta = (np.arange(len(lobe())) + 0.5) / len(lobe()) * np.pi
    assert (lobe()[:, 0, 0] * np.sin(theta)).sum() * 2 * np.pi**2 / len(theta) == pytest.approx(1, rel=5e-3)
    for k, wanted in enumerate(studio.poses.lights):
        studio.set_up(k)
        studio.parameters.update()
        si = dr.zeros(mi.SurfaceInteraction3f, 1)
        si.wi = mi.Vector3f((-wanted).tolist())
        assert float(studio.scene.environment().eval(si)[0][0]) == pytest.approx(lobe().max(), rel=0.02)
    poses = Poses.around(np.zeros(3), np.ones(3), 100, 0)
    assert (poses.eyes[:, 1] > 0.5).all() and abs(poses.lights.mean()) < 0.15
