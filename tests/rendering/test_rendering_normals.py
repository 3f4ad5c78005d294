"""Objects that are mirrored, turned inside out or wound the other way are the same objects."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pytest
from rendered import MEDIUM, direction, independent, surface
from scipy import stats

mi = pytest.importorskip("mitsuba")

LAMP = {"type": "sphere", "center": [12, 3, 12], "radius": 2.0, "emitter": {"type": "area", "radiance": 10.0}}
PASSES, SPP = 6, 112  # Student's t of 10 degrees of freedom
LIGHTS = {"sky": {"type": "constant"}, "lamp": LAMP}


@pytest.fixture(autouse=True)
def _variant():
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # of objects that are not closed
        yield


def ellipsoid() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a closed mesh, wound so that its normals point outwards."""
    n, m = 24, 12
    theta, phi = np.meshgrid(np.linspace(0, np.pi, m + 1)[1:-1], 2 * np.pi * np.arange(n) / n, indexing="ij")
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, 1]], ring, [[0, 0, -1]]]) * [3.0, 4.0, 5.0]
    faces = []
    for j in range(n):
        k = (j + 1) % n
        faces.append([0, 1 + j, 1 + k])
        for i in range(0, (m - 2) * n, n):
            faces += [[1 + i + j, 1 + i + n + j, 1 + i + n + k], [1 + i + j, 1 + i + n + k, 1 + i + k]]
        last = 1 + (m - 2) * n
        faces.append([len(vertices) - 1, last + k, last + j])
    return vertices, np.array(faces)


def mesh(folder, reverse: bool, normals: bool, flip: bool = False, mirror: bool = False) -> dict:
    """An OBJ file of the ellipsoid; its vertex normals point outwards whatever the winding."""
    vertices, faces = ellipsoid()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    if normals:
        lines += [f"vn {x} {y} {z}" for x, y, z in vertices / [9.0, 16.0, 25.0]]
    for face in (faces[:, ::-1] if reverse else faces) + 1:
        lines.append("f " + " ".join(f"{k}//{k}" if normals else str(k) for k in face))
    path = folder / f"ellipsoid_{reverse}_{normals}.obj"
    path.write_text("\n".join(lines))
    shape = {"type": "obj", "filename": str(path), "face_normals": not normals, "flip_normals": flip}
    return {**shape, "to_world": mi.ScalarTransform4f().scale([-1, 1, 1])} if mirror else shape


def image(shape: dict, light: str, bsdf: dict | None = None, integrator: str = "bssrdf", seed: int = 1,
          passes: int = PASSES, spp: int = SPP) -> np.ndarray:  # fmt: skip
    """Independent images, grey, stacked first."""
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at((30 * direction(20)).tolist(), [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 18.0, "to_world": at, "film": film}
    shape = {**shape, "bsdf": bsdf or {**surface(orders="total"), "reflection": True}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": integrator, "hide_emitters": True},
                          "light": LIGHTS[light], "object": shape, "sensor": sensor})  # fmt: skip
    return independent(scene, passes, spp, 100 * seed).mean(axis=3)


def same(a: np.ndarray, b: np.ndarray) -> None:
    """z-tests of the mean of the image and of its pixels, both at a significance of 1e-4."""
    means = a.mean(axis=(1, 2)), b.mean(axis=(1, 2))
    assert stats.ttest_ind(*means).pvalue > 1e-4, [mean.mean() for mean in means]
    noisy = np.concatenate([a, b]).std(axis=0) > 1e-6
    assert np.allclose(a.mean(axis=0)[~noisy], b.mean(axis=0)[~noisy], atol=1e-5)
    p = stats.ttest_ind(a[:, noisy], b[:, noisy]).pvalue
    assert p.min() * p.size > 1e-4


@pytest.mark.slow
def test_a_mesh_with_normals_looks_the_same_however_it_is_wound_flipped_and_mirrored(tmp_path):
    upright = image(mesh(tmp_path, False, True), "lamp")
    for reverse, flip, mirror in ((True, False, False), (False, True, False), (False, False, True), (True, True, True)):
        same(image(mesh(tmp_path, reverse, True, flip, mirror), "lamp", seed=2), upright)


@pytest.mark.slow
def test_a_sphere_looks_the_same_flipped_and_mirrored():
    upright = image({"type": "sphere", "radius": 4.0}, "lamp")
    for flip, sign in ((True, 1), (False, -1), (True, -1)):
        to_world = mi.ScalarTransform4f().scale([sign * 4.0, 4.0, 4.0])
        same(image({"type": "sphere", "flip_normals": flip, "to_world": to_world}, "lamp", seed=2), upright)


@pytest.mark.parametrize("integrator", ["path", "translucent_walk"])
def test_a_rough_boundary_looks_the_same_inside_out(integrator):
    rough = {"type": "roughdielectric", "alpha_u": 0.02, "alpha_v": 0.5, "int_ior": 1.4, "ext_ior": 1.0}
    bsdf = {**surface(orders="total"), "reflection": True, "boundary": rough}
    ball = {"type": "sphere", "radius": 4.0}
    same(*(image({**ball, "flip_normals": flip}, "sky", bsdf, integrator, flip + 1, 12, 256) for flip in (False, True)))


def test_a_constant_sky_is_nowhere_outshone(tmp_path):
    for reverse, normals in itertools.product((False, True), repeat=2):
        assert image(mesh(tmp_path, reverse, normals), "sky").mean(axis=0).max() < 1.02


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["bssrdf", "translucent_walk"])
def test_each_piece_of_a_mesh_has_its_own_outside(integrator, tmp_path):
    """One of two bodies in a file is wound the other way: the file is rendered as if it were not."""
    images = []
    vertices, faces = ellipsoid()
    both = np.concatenate([0.5 * vertices + [2.2, 0, 0], 0.5 * vertices - [2.2, 0, 0]])
    for seed, second in enumerate((faces, faces[:, ::-1])):
        lines = [f"v {x} {y} {z}" for x, y, z in both]
        lines += [f"f {a} {b} {c}" for a, b, c in np.concatenate([faces, second + len(vertices)]) + 1]
        (tmp_path / "two.obj").write_text("\n".join(lines))
        shape = {"type": "obj", "filename": str(tmp_path / "two.obj"), "face_normals": True}
        images.append(image(shape, "lamp", integrator=integrator, seed=seed + 1))
    same(*images)


def test_the_walk_sees_vertex_normals_that_disagree_with_the_winding_as_the_right_way_round(tmp_path):
    same(*(image(mesh(tmp_path, reverse, True), "sky", integrator="translucent_walk", seed=reverse + 1)
           for reverse in (False, True)))  # fmt: skip


def test_other_integrators_see_the_reflection_from_outside_on_both_sides_of_a_surface():
    bsdf = {"type": "translucent", "model": "standard_dipole", **MEDIUM}
    same(*(image({"type": "sphere", "radius": 4.0, "flip_normals": flip}, "sky", bsdf, "path", seed=flip + 1)
           for flip in (False, True)))  # fmt: skip
