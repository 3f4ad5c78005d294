"""Points of entry: chi-square tests of the sampler on a plane and a sphere, and what must not matter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from halfspace_sss import Medium, bssrdf

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

N = 1 << 18
MODELS = [Medium(1.0, 0.2, 0.3, 1.4), Medium(0.3, 0.01, 0.0, 1.4), Medium(3.0, 0.5, 0.0, 1.4)]

pytestmark = pytest.mark.usefixtures("quiet_rgb")


def position_sampler(shape: dict, share: float):
    from full_geometry.geometry.points import AreaPoints, PositionSampler, RadialTable
    from full_geometry.geometry.shape import analyse_shape

    scene = mi.load_dict({"type": "scene", "object": shape})
    found = analyse_shape(scene.shapes()[0])
    table = RadialTable([bssrdf("standard_dipole", m) for m in MODELS], found.size)
    return PositionSampler(found, table, AreaPoints(found.shape), share)


def entries(positions, origin, along, n: int = N, seed: int = 1):
    from full_geometry.geometry.points import SurfacePoint

    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*along))
    si = positions.geometry.scene.ray_intersect(ray)
    sign = positions.geometry.sign
    out = SurfacePoint(mi.Point3f(si.p), mi.Normal3f(si.n) * sign, mi.Normal3f(si.sh_frame.n) * sign, -ray.d, sign)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    return out, positions.sample(out, si.prim_index, sampler, mi.Bool(True))


def chi_square(counts: np.ndarray, expected: np.ndarray) -> float:
    """p-value, cells with few expected counts put together."""
    few = expected < 20
    counts = np.append(counts[~few], counts[few].sum())
    expected = np.append(expected[~few], expected[few].sum())
    keep = expected > 0
    chi2 = np.sum((counts[keep] - expected[keep]) ** 2 / expected[keep])
    return float(stats.chi2.sf(chi2, keep.sum() - 1))


def agree_with_area(index: np.ndarray, weight: np.ndarray, areas: np.ndarray) -> float:
    """p-value of sums of weights in cells against their areas."""
    first, second = (np.bincount(index, weight**k, len(areas)) / N for k in (1, 2))
    z = (first - areas) / np.sqrt((second - first**2) / N)
    return float(stats.chi2.sf(np.sum(z**2), len(z)))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_weights_of_entries_on_a_plane_sum_up_to_the_area_of_each_cell(share):
    """Of all candidates one is taken, so its density is not known, but E[sum of weights in a cell] is the area."""
    half, cells = 4.0, 12
    shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half)}
    out, entry = entries(position_sampler(shape, share), (0.3, -0.2, 5), (0, 0, -1))
    weight = np.array(entry.weight)
    x, y = (np.clip(((v / half + 1) / 2 * cells).astype(int), 0, cells - 1) for v in np.array(entry.p)[:2])
    areas = np.full(cells * cells, (2 * half / cells) ** 2)
    assert agree_with_area(np.where(weight > 0, x * cells + y, 0), weight, areas) > 1e-3


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_weights_of_entries_on_a_sphere_sum_up_to_the_area_of_each_cell(share):
    positions = position_sampler({"type": "sphere", "radius": 2.0}, share)
    out, entry = entries(positions, (0.4, 0.3, 9), (0, 0, -1))
    weight, p = np.array(entry.weight), np.array(entry.p) / 2.0
    cells_z, cells_phi = 12, 16
    k = np.clip(((p[2] + 1) / 2 * cells_z).astype(int), 0, cells_z - 1)
    j = ((np.arctan2(p[1], p[0]) / (2 * np.pi) + 0.5) * cells_phi).astype(int) % cells_phi
    areas = np.full(cells_z * cells_phi, 4 * np.pi * 4.0 / (cells_z * cells_phi))
    assert agree_with_area(np.where(weight > 0, k * cells_phi + j, 0), weight, areas) > 1e-3


def test_a_probe_alone_on_a_plane_follows_its_density():
    half, cells, fine = 4.0, 24, 32
    shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half)}
    positions = position_sampler(shape, 0.0)
    out, entry = entries(positions, (0.3, -0.2, 5), (0, 0, -1))
    x, y = np.array(entry.p)[:2, np.array(entry.weight) > 0]
    edges = np.linspace(-half, half, cells + 1)
    counts = np.histogram2d(x, y, bins=(edges, edges))[0]
    middle = (np.arange(cells * fine) + 0.5) / (cells * fine) * 2 * half - half
    X, Y = np.meshgrid(middle, middle, indexing="ij")
    p = mi.Point3f(np.stack([X.ravel(), Y.ravel(), np.zeros(X.size)]))
    axes = (out.n, *mi.coordinate_system(out.n))
    density = np.array(positions.density(p, mi.Normal3f(0, 0, 1), mi.UInt32(0), out, axes))
    mass = density.reshape(cells, fine, cells, fine).mean(axis=(1, 3)) * (2 * half / cells) ** 2
    keep = mass < 0.3 * mass.max()  # about the exit the density is too steep for this grid
    counts = np.append(counts[keep], N - counts[keep].sum())
    assert chi_square(counts, N * np.append(mass[keep], 1 - mass[keep].sum())) > 1e-3


def test_points_over_the_area_beside_a_probe_cut_variance_and_tail_across_a_gap_of_air():
    """Two plates joined at one end: light at the inner side of one may enter at that of the other."""
    plates = prongs()
    found = []
    for share in (0.0, 0.9):
        out, entry = entries(position_sampler(plates, share), (1.0, 0.5, 5), (0, 0, -1))
        found.append(np.array(dr.exp(-dr.norm(entry.p - out.p)) * entry.weight, dtype=float))
    (a, b), errors = (v.mean() for v in found), [v.std() / np.sqrt(N) for v in found]
    assert abs(a - b) < 4 * np.hypot(*errors)
    assert found[1].var() < 0.6 * found[0].var() and found[1].max() < 0.7 * found[0].max()


def prongs():
    """A tuning fork, 4 x 1 x 1, of two prongs of thickness 0.3 that are joined at x = -2."""
    outline = [(-2, -0.5), (2, -0.5), (2, -0.2), (-1.7, -0.2), (-1.7, 0.2), (2, 0.2), (2, 0.5), (-2, 0.5)]
    n = len(outline)
    vertices = np.array([(x, y, z) for y in (0.0, 1.0) for x, z in outline])
    cap = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 7), (4, 5, 6), (4, 6, 7)])
    k = np.arange(n)
    nxt = (k + 1) % n
    sides = np.concatenate([np.stack([k, k + n, nxt + n], 1), np.stack([k, nxt + n, nxt], 1)])
    faces = np.concatenate([cap, cap[:, ::-1] + n, sides])
    mesh = mi.Mesh("prongs", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel().astype(np.uint32)
    parameters.update()
    return mesh


def kernel_integral(positions, origin, along):
    """∫ exp(-|x - x_o|) dA and its standard error."""
    out, entry = entries(positions, origin, along)
    value = np.array(dr.exp(-dr.norm(entry.p - out.p)) * entry.weight)
    return value.mean(), value.std() / np.sqrt(N)


def test_faces_of_a_mesh_do_not_matter():
    coarse = position_sampler({"type": "cube"}, 0.2)
    parts = [kernel_integral(coarse, (0.2, 0.1, 5), (0, 0, -1))]
    box = mi.load_dict({"type": "cube"})
    vertices, faces = subdivided(box)
    mesh = mi.Mesh("fine", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(vertices)
    parameters["faces"] = np.ravel(faces)
    parameters.update()
    parts.append(kernel_integral(position_sampler(mesh, 0.2), (0.2, 0.1, 5), (0, 0, -1)))
    (a, e), (b, f) = parts
    assert abs(a - b) < 4 * np.hypot(e, f)


def test_what_lies_straight_behind_a_thin_object_is_found_by_probes():
    """Probes are short but for a few; the other side of a plate is parallel to all that run along its tangents."""
    plate = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([2, 2, 0.3])}
    (a, e), (b, f) = (kernel_integral(position_sampler(plate, share), (0.2, 0.1, 5), (0, 0, -1)) for share in (0, 1))
    assert abs(a - b) < 4 * np.hypot(e, f)
    assert e < 0.01 * a


def subdivided(mesh):
    """Each triangle as four."""
    parameters = mi.traverse(mesh)
    v = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    f = np.array(parameters["faces"]).reshape(-1, 3)
    a, b, c = v[f[:, 0]], v[f[:, 1]], v[f[:, 2]]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    triangles = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles), dtype=np.uint32).reshape(-1, 3)


def test_light_does_not_cross_from_one_object_to_another_of_the_same_surface():
    """Mitsuba merges meshes with the same BSDF into one shape."""
    at = mi.ScalarTransform4f()
    bsdf = {"type": "translucent", "material": "marble"}
    scene = mi.load_dict({
        "type": "scene", "a": {"type": "cube", "bsdf": bsdf},
        "b": {"type": "cube", "to_world": at.translate([2.5, 0, 0]), "bsdf": bsdf},
    })  # fmt: skip
    assert len(scene.shapes()) == 1
    positions = position_sampler(scene.shapes()[0], 0.3)
    out, entry = entries(positions, (0.9, 0, 5), (0, 0, -1))
    found = np.array(entry.weight) > 0
    assert found.any() and np.array(entry.p)[0, found].max() < 1.01


def test_the_radial_table_gives_back_its_own_density():
    from full_geometry.geometry.points import RadialTable

    table = RadialTable([bssrdf("standard_dipole", m) for m in MODELS], 50.0)
    u = mi.Float((np.arange(N) + 0.5) / N)
    r = np.array(table.sample(u))
    edges = np.geomspace(1e-3, 49.9, 60)
    counts = np.histogram(r, bins=edges)[0]
    fine = np.geomspace(1e-3, 49.9, 59 * 40 + 1)
    middle = np.sqrt(fine[1:] * fine[:-1])
    mass = (np.array(table.pdf(mi.Float(middle))) * 2 * np.pi * middle * np.diff(fine)).reshape(59, 40).sum(axis=1)
    assert np.allclose(counts / N, mass, rtol=0.05, atol=2e-5)
