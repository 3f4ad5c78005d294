"""The geometry of one translucent object: its faces and pieces, which side is outside, whether it is closed."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from full_geometry.geometry import mesh
from full_geometry.geometry.rounding import bound_of, box_ends, ray_from
from full_geometry.geometry.snapshot import Snapshot
from halfspace_sss.arrays import aligned

MOST_COPIES = 1e-3  # share of the area in faces that exist twice, by which light may then be wrong
CREASES = 0.01  # of the corners whose vertex normal may be on the other side of the face, as at sharp edges


@dataclass(frozen=True, eq=False)
class Faces:
    """The connected faces of a mesh.

    Args:
        corners: integer array (n, 3), the places of the corners of each face; equal where positions are.
        normals: array (n, 3), normal times area of each face, by its winding.
        pieces: integer array (n,), the connected piece of each face, over shared positions; over shared edges where
            faces point to both sides.
        sides: array (n,) of 1 and -1, the factors that turn normals of each piece to one side; None
            where they do.
        closed: whether an even number of faces meets at each edge, so that what enters leaves again.
    """

    corners: np.ndarray
    normals: np.ndarray
    pieces: np.ndarray
    sides: np.ndarray | None
    closed: bool


def faces_of(shape: mi.Shape, name: str) -> Faces | None:
    """The faces of a shape that is a mesh; None for others.
    ValueError if a surface of the mesh, called `name`, has one side only, as a Möbius strip has."""
    if not mesh.has_faces(shape):
        return None
    faces, positions = mesh.face_vertices(shape), mesh.vertex_positions(shape).astype(float)
    _, place = np.unique(positions, axis=0, return_inverse=True)
    corners = place.reshape(-1)[faces]
    a, b, c = positions[faces].transpose(1, 0, 2)
    normals = 0.5 * np.cross(b - a, c - a)
    edges = _edges(corners)
    first, second, same = _neighbours(corners, edges, np.linalg.norm(normals, axis=1) > 0)
    closed = bool((edges[2] % 2 == 0).all())
    if same.all():
        return Faces(corners, normals, _pieces(corners), None, closed)
    pieces, sides = _turned(len(faces), first, second, same, name)
    return Faces(corners, normals, pieces, sides, closed)


def check_copies(faces: Faces, name: str) -> None:
    """Refuse a mesh whose faces exist twice, in either winding: light would enter by both.
    ValueError if more than `MOST_COPIES` of the area is in copies of other faces."""
    corners = np.sort(faces.corners, axis=1)
    order = np.lexsort(corners.T)
    copies = np.zeros(len(corners), dtype=bool)
    copies[order[1:]] = (np.diff(corners[order], axis=0) == 0).all(axis=1)
    area = np.linalg.norm(faces.normals, axis=1)
    share = area[copies].sum() / max(area.sum(), np.finfo(float).tiny)
    if share > MOST_COPIES:
        raise ValueError(
            f"faces of object {name} must exist once, got {int(copies.sum())} of {len(copies)} that are copies of "
            f"others, {100 * share:.3g} % of the area: remove one of each two"
        )


def face_normals_agree(shape: mi.Shape, faces: Faces, name: str) -> None:
    """Warn that faces were turned, and make vertex normals anew that were averaged over faces of both sides."""
    turned = int(min((faces.sides < 0).sum(), (faces.sides > 0).sum()))
    more = ""
    if shape.has_vertex_normals():
        vertex, positions = mesh.face_vertices(shape), mesh.vertex_positions(shape).astype(float)
        normals = faces.normals * faces.sides[:, None]
        known = mesh.vertex_normals(shape).astype(float)
        above = float((np.einsum("fkx,fx->fk", known[vertex], normals) > 0).mean())
        if min(above, 1 - above) > CREASES:
            mesh.set_vertex_normals(shape, _vertex_normals(positions, vertex, normals))
            more = ", and vertex normals were made anew"
    warnings.warn(
        f"faces of object {name} point to both sides: {turned} of {len(faces.sides)} were turned{more}", stacklevel=3
    )


def _vertex_normals(positions: np.ndarray, vertex: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Means of the normals of faces about each vertex, by their angles there, as Mitsuba makes them."""

    def unit(v: np.ndarray) -> np.ndarray:
        return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), np.finfo(float).tiny)

    corners, result = positions[vertex], np.zeros_like(positions)
    for k in range(3):
        a, b = (unit(corners[:, (k + j) % 3] - corners[:, k]) for j in (1, 2))
        angle = 2 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
        np.add.at(result, vertex[:, k], angle[:, None] * unit(normals))
    return unit(result)


def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The sides of all faces by the edges that they lie on, where each edge begins in these, and its number of sides.
    Side 3 f + k runs from corner k of face f to the next. Sides of no length are on no edge."""
    ends = np.sort(np.stack([corners.ravel(), np.roll(corners, -1, axis=1).ravel()]), axis=0)
    order = np.lexsort(ends[::-1])
    order = order[ends[0, order] != ends[1, order]]
    first = np.flatnonzero(np.append(True, (np.diff(ends[:, order]) != 0).any(axis=0))[: len(order)])
    return order, first, np.diff(np.append(first, len(order)))


def _neighbours(corners: np.ndarray, edges: tuple, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of faces that share an edge which no third one has, and whether they run along it in opposite ways.
    Faces without area, which are not `solid`, have no side to agree with."""
    order, first, count = edges
    pair = order[first[count == 2][:, None] + [0, 1]]
    pair = pair[solid[pair // 3].all(axis=1)]
    start = corners.ravel()[pair]
    return pair[:, 0] // 3, pair[:, 1] // 3, start[:, 0] != start[:, 1]


def _pieces(corners: np.ndarray) -> np.ndarray:
    ends = np.concatenate([corners[:, :2], corners[:, 1:]])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(corners.max() + 1,) * 2)
    return connected_components(graph, directed=False)[1][corners[:, 0]]


def _turned(n: int, first: np.ndarray, second: np.ndarray, same: np.ndarray, name: str) -> tuple:
    """Pieces over shared edges, and the sides by which their faces agree.
    In a graph of two nodes for each face, one for each side, an edge of the mesh joins the sides that agree. Both sides
    of a piece are components of it; where they are one, the surface has one side only."""
    other = np.where(same, 0, n)
    ends = np.concatenate([first, first + n]), np.concatenate([second + other, second + n - other])
    graph = coo_array((np.ones(2 * len(first)), ends), shape=(2 * n, 2 * n))
    label = connected_components(graph, directed=False)[1]
    if (label[:n] == label[n:]).any():
        raise ValueError(f"faces of object {name} point to both sides: they must have two sides, got a one-sided strip")
    least = np.minimum(label[:n], label[n:])
    return np.unique(least, return_inverse=True)[1].reshape(-1), np.where(label[:n] == least, 1.0, -1.0)


RAYS = 4096  # of `analyse_shape`
MOST_HITS = 64  # that one ray counts
Pointer = "mi.ShapePtr | mi.EmitterPtr | mi.BSDFPtr"  # of Dr.Jit's registry
HIDDEN = 5e-3  # of hits may be on the wrong side, or rays odd: between faces pass fewer, inside other pieces are more
MAJORITY = 0.75  # of the first hits from outside agree on the side of the normals, unless the object is a sheet


@dataclass(frozen=True, eq=False)
class Geometry:
    """A shape with a translucent surface.

    Args:
        scene: a scene that holds this shape only.
        sign: 1 if its geometric normals point outwards, -1 if inwards.
        signs: Float array of the same for each face, or None if it is the same for all.
        agree: whether shading normals are on the side of the geometric ones, as far as was seen.
        closed: whether rays that enter also leave.
        pieces: UInt32 array of the connected piece of each face, or None if there is one piece.
        size: diagonal of the bounding box, scene units.
        area: scene units squared.
        state: `geometry_of` the shape when it was analysed.
        inclusions: the `Inclusions` that lie inside, for a transport that takes them; None where nothing does.
        group: the `instances.Group` whose instances show the shape; None of a shape that stands in the scene itself.
        transform: the `InstanceTransform` of the instance that is met, for rays of the scene; without it rays of a
            shape in a group are in the frame of the group.
        lost: share of the rays that enter it and do not leave again.
    """

    shape: mi.Shape
    scene: mi.Scene
    sign: float
    signs: mi.Float | None
    agree: bool
    closed: bool
    pieces: mi.UInt32 | None
    size: float
    area: float
    state: Snapshot
    inclusions: Any = None
    group: Any = None
    transform: Any = None
    lost: float = 0.0

    @property
    def name(self) -> str:
        return name_of(self.shape)

    def is_current(self) -> bool:
        """Whether the shape, and surfaces inside it, still are as they were."""
        same = geometry_of(self.shape) == self.state
        return same and (self.inclusions is None or self.inclusions.is_current())

    def piece(self, prim_index: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The number of the piece that a face belongs to."""
        if self.pieces is None:
            return mi.UInt32(0)
        return dr.gather(mi.UInt32, self.pieces, prim_index, active)

    @property
    def rounding(self) -> float:
        """A bound of how far from its surface rounding puts points, scene units."""
        return bound_of(self.shape)

    @property
    def clearance(self) -> mi.Float:
        """`rounding` as data of kernels; of an instance where that stands."""
        return dr.opaque(mi.Float, self.rounding) if self.transform is None else self.transform.rounding

    def as_instance(self, transform: Any) -> Geometry:
        """The geometry of one instance; its size is that of the largest."""
        return replace(self, transform=transform, size=self.size * self.group.longest)

    def ray_intersect(
        self, ray: mi.Ray3f, flags: int, coherent: bool = False, active: mi.Bool | bool = True
    ) -> mi.SurfaceInteraction3f:
        if self.group is None:
            return self.scene.ray_intersect(ray, flags, coherent, active)
        if self.transform is None:
            return meet_alone(self.scene, ray, flags, active)
        si = self.transform.interaction_to_world(
            meet_alone(self.scene, self.transform.ray_to_object(ray), flags, active), flags
        )
        return completed(si, si, ray, flags, active & si.is_valid())

    def ray_test(self, ray: mi.Ray3f, coherent: bool = False, active: mi.Bool | bool = True) -> mi.Bool:
        return self.scene.ray_test(
            ray if self.transform is None else self.transform.ray_to_object(ray), coherent, active
        )

    def ray_onto(self, p: mi.Point3f, n: mi.Normal3f) -> tuple[mi.Ray3f, mi.Float]:
        """A short ray onto the surface at a point with its outward normal, and how far that is."""
        off = dr.maximum(10 * self.clearance, dr.opaque(mi.Float, 1e-5 * self.size))
        return mi.Ray3f(mi.Point3f(p + n * off), mi.Vector3f(-n)), off

    @property
    def upright(self) -> bool:
        """Whether every normal points outwards."""
        return self.sign > 0 and self.signs is None and self.agree

    @functools.cached_property
    def bend_of_normals(self) -> float:
        """Mean angle of interpolated normals with the surface, radians; 0 of shapes other than meshes."""
        return mesh.bend_of_normals(self.shape) if self.shape.is_mesh() else 0.0

    @property
    def curvature_sign(self) -> float:
        """-1 for a mesh with flip_normals, whose normals Mitsuba turns, but not their derivatives."""
        return -1.0 if self.shape.is_mesh() and mesh.is_flipped(self.shape) else 1.0

    def tangents(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Vector3f]:
        """dp_du and dp_dv by the parameters that dn_du and dn_dv are by: of a mesh Mitsuba has those of normals by
        barycentric coordinates, those of points by uv where it has any."""
        if not (self.shape.is_mesh() and self.shape.has_vertex_texcoords()):
            return si.dp_du, si.dp_dv
        a, b, c = mesh.positions_at(self.shape, mesh.vertices_of(self.shape, si.prim_index, active), active)
        edges = mi.Vector3f(b - a), mi.Vector3f(c - a)
        return edges if self.transform is None else tuple(map(self.transform.vector_to_world, edges))

    def side(self, prim_index: mi.UInt32, active: mi.Bool = True) -> mi.Float:
        """1 where the geometric normal of a face points outwards, -1 where it points inwards."""
        if self.signs is None:
            return mi.Float(self.sign)
        return dr.gather(mi.Float, self.signs, prim_index, active)


def analyse_shape(shape: mi.Shape, world: mi.Scene | None = None, groups: Iterable[Any] = ()) -> Geometry:
    """Find by rays from outside which side of a shape is out; warns if it is open or its faces point to both sides.

    A mesh is closed if its edges say so. Rays decide for others, and where edges of faces that touch do not match.
    Faces of a closed mesh that point to both sides are taken the right way round.

    Args:
        world: the scene that it stands in, if rays are traced in both by one kernel.
        groups: `instances.Group` of each group that instances in the scene show.

    Raises:
        ValueError: the shape is an instance, whose geometry belongs to several objects; faces of a mesh exist twice;
            closed pieces of it touch or overlap; faces point to both sides of a surface that has one side or is not
            closed; or a sphere is stretched.
    """
    if is_instance(shape):
        raise ValueError(f"a translucent object must not be an instance, got {shape.id() or shape}")
    if shape.is_mesh() and shape.face_count() == 0:
        raise ValueError(f"a mesh must have faces, got none in {name_of(shape)}")
    if shape.class_name() == "Sphere":  # rays would meet a ball that is shaded as another shape
        check_stretch(f"object {name_of(shape)}", mi.traverse(shape)["to_world"], any_size=True)
    scene = scene_of([shape], world)
    low, high = box_ends(scene.bbox())
    size = float(np.linalg.norm(high - low))
    faces = faces_of(shape, name_of(shape))
    if faces is not None:
        check_copies(faces, name_of(shape))
    votes = _Votes(faces)
    # of each ray from outside the side of its first hit, and how many do not leave what they enter
    sides, count = (np.array(v) for v in crossings(scene, rays_into(scene.bbox(), RAYS), votes))
    odd = float((count[count > 0] % 2).mean()) if (count > 0).any() else 0.0
    if faces is not None and faces.closed:
        wrong, odd = max(odd, votes.wrong()), 0.0  # rays pass between faces by rounding
        if wrong > HIDDEN:
            raise ValueError(
                f"pieces of object {name_of(shape)} must not touch or overlap, got {100 * wrong:.3g} % of the hits of "
                "rays inside others: join them, or move them apart"
            )
    outward = sides[sides != 0]
    share = float((outward > 0).mean()) if len(outward) else 1.0
    sheet = 1 - MAJORITY < share < MAJORITY and not votes.agree()
    mixed = faces is not None and faces.sides is not None
    if mixed and (odd > 0 or sheet):
        raise ValueError(
            f"faces of object {name_of(shape)} point to both sides, and the object must be closed to tell its inside, "
            f"got {100 * odd:.3g} % of the rays that enter it and do not leave it again"
        )
    if mixed:
        face_normals_agree(shape, faces, name_of(shape))
    if odd > 0 or sheet:
        warnings.warn(
            f"object {name_of(shape)} is not closed: {100 * odd:.3g} % of the rays that enter it do not leave it "
            "again; light that enters or leaves at the gap is lost",
            stacklevel=2,
        )
    area = float(np.sum(np.array(shape.surface_area())))
    closed, sign = odd == 0 and not sheet, -1.0 if share <= 1 - MAJORITY else 1.0
    signs = votes.signs() if closed else None
    return Geometry(
        shape=shape, scene=scene, sign=sign, signs=signs, agree=float(votes.opposed[0]) == 0, closed=closed,
        pieces=votes.pieces, size=size, area=area, state=geometry_of(shape), lost=odd,
        group=next((group for group in groups if any(shape is part for part in group.shapes)), None),
    )  # fmt: skip


UNEVEN = 1e-3  # of scales along axes


def check_stretch(name: str, to_world: mi.Transform4f, any_size: bool = False) -> None:
    """ValueError if a transformation stretches, as rotations do about an axis of another length than 1.
    `any_size`: whether it may change the size."""
    scales = np.linalg.svd(matrix_of(to_world)[:3, :3], compute_uv=False)
    if scales[0] - scales[-1] > UNEVEN * scales[0] or not (any_size or abs(scales[0] - 1) < UNEVEN):
        raise ValueError(
            f"to_world of {name} must {'not stretch' if any_size else 'turn'} it, and axes of rotations have the "
            f"length 1, got scales from {scales[-1]:.3g} to {scales[0]:.3g}"
        )


PLACES = (*mesh.GEOMETRY, "to_world", "grid", "control_points", "data", "extent")


def geometry_of(shape: mi.Shape) -> Snapshot:
    """A snapshot of the parameters that say where a shape is."""
    return Snapshot(shape, PLACES.__contains__)


def matrix_of(to_world: mi.Transform4f) -> np.ndarray:
    """The matrix (4, 4) of a transformation, read number by number: as one array it would take a kernel."""
    matrix = dr.detach(to_world).matrix
    return np.array([[matrix[row, column][0] for column in range(4)] for row in range(4)], dtype=float)


class _Votes:
    """Votes of hits on each piece: the normals point outwards if they are against a ray that enters.
    A ray from outside enters a closed object with its first, third, ... hit, whatever hides the piece."""

    def __init__(self, faces: Faces | None) -> None:
        n = 0 if faces is None else int(faces.pieces.max()) + 1
        mixed = faces is not None and faces.sides is not None
        n = n if n > 1 or mixed else 0
        self.pieces = aligned(mi.UInt32, faces.pieces) if n else None
        self.sides = aligned(mi.Float, faces.sides) if mixed else None
        self.hits, self.outward = dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)
        self.opposed = dr.zeros(mi.Float, 1)

    def add(self, si: mi.SurfaceInteraction3f, along: mi.Vector3f, entering: mi.Bool, active: mi.Bool) -> None:
        dr.scatter_add(self.opposed, mi.Float(1), 0, active & (dr.dot(si.sh_frame.n, si.n) < 0))
        if self.pieces is None:
            return
        piece = dr.gather(mi.UInt32, self.pieces, si.prim_index, active)
        n = si.n if self.sides is None else si.n * dr.gather(mi.Float, self.sides, si.prim_index, active)
        agrees = (dr.dot(n, along) < 0) == entering
        dr.scatter_add(self.hits, mi.Float(1), piece, active)
        dr.scatter_add(self.outward, dr.select(agrees, mi.Float(1), 0), piece, active)

    def _shares(self) -> np.ndarray:
        hits = np.array(self.hits)
        return np.where(hits > 0, np.array(self.outward) / np.maximum(hits, 1), 1.0)

    def wrong(self) -> float:
        """Share of the hits that contradict the others on their piece, as those inside another piece do."""
        hits, outward = np.array(self.hits), np.array(self.outward)
        return float(np.minimum(outward, hits - outward).sum() / max(hits.sum(), 1))

    def agree(self) -> bool:
        """Whether there are pieces, and the hits on each say the same."""
        shares = self._shares()
        return len(shares) > 0 and bool((np.abs(shares - 0.5) >= MAJORITY - 0.5).all())

    def signs(self) -> mi.Float | None:
        """The sign of each face, or None if it is the same for all."""
        if self.pieces is None:
            return None
        sign = np.where(self._shares() < 0.5, -1.0, 1.0)[np.array(self.pieces)]
        sign = sign if self.sides is None else sign * np.array(self.sides)
        return aligned(mi.Float, sign) if np.ptp(sign) > 0 else None


def crossings(scene: mi.Scene, ray: mi.Ray3f, votes: _Votes | None = None) -> tuple[mi.Float, mi.UInt32]:
    """Side of the first hit of each ray (1: the normal points to the ray, 0: no hit) and the number of hits."""

    def step(ray: mi.Ray3f, side: mi.Float, count: mi.UInt32, active: mi.Bool) -> tuple:
        si = meet_alone(scene, ray, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
        active &= si.is_valid()
        first = dr.select(dr.dot(si.n, ray.d) < 0, 1.0, -1.0)
        if votes is not None:
            votes.add(si, ray.d, (count & 1) == 0, active)
        side = dr.select(active & (count == 0), first, side)
        count = dr.select(active, count + 1, count)
        return dr.select(active, ray_from(si, ray.d, e), ray), side, count, active & (count < MOST_HITS)

    n, e = dr.width(ray), dr.opaque(mi.Float, max(map(bound_of, scene.shapes()), default=0.0))
    state = (ray, dr.zeros(mi.Float, n), dr.zeros(mi.UInt32, n), dr.full(mi.Bool, True, n))
    return dr.while_loop(state, lambda ray, side, count, active: active, step, label="crossings")[1:3]


def meet_alone(scene: mi.Scene, ray: mi.Ray3f, flags: int, active: mi.Bool | bool = True) -> mi.SurfaceInteraction3f:
    """Intersect a ray with a scene of one shape, by the function of this shape.
    Mitsuba would have functions of all shapes that exist in the kernel, those of other scenes too; of a thousand
    instances that takes minutes."""
    (shape,) = (each for each in scene.shapes()) if len(scene.shapes()) == 1 else (None,)
    if shape is None or is_instance(shape):
        return scene.ray_intersect(ray, flags, False, active)
    hit = scene.ray_intersect_preliminary(ray, False, active=active)
    active = active & hit.is_valid()
    si = shape.compute_surface_interaction(ray, hit, flags, active)
    si.shape = dr.select(active, mi.ShapePtr(shape), None)
    return completed(si, hit, ray, flags, active)


def completed(
    si: mi.SurfaceInteraction3f, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, flags: int, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """An interaction with what no shape knows: the distance, the direction to the ray's origin and the tangents."""
    si.t, si.prim_index = dr.select(active, hit.t, dr.inf), hit.prim_index
    si.time, si.wavelengths = ray.time, ray.wavelengths
    if flags & mi.RayFlags.ShadingFrame:
        si.initialize_sh_frame()
    si.wi = dr.select(active, si.to_local(-ray.d), -ray.d)
    return si


FEW, MANY = 3, 65  # rays from a point, which decide where they agree, and where they do not


def is_inside(geometry: Geometry, points: np.ndarray) -> np.ndarray:
    """Which points (array of shape (3, n)) lie inside a closed object, by the parity of the hits of rays from them."""
    points = np.asarray(points, dtype=float)
    result = np.zeros(points.shape[1], dtype=bool)
    if not geometry.closed:
        return result
    low, high = box_ends(geometry.scene.bbox())[..., None]
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=0))
    share = _odd_share(geometry, points[:, near], FEW)
    result[near] = share > 0.5
    doubtful = near[(share > 0) & (share < 1)]
    result[doubtful] = _odd_share(geometry, points[:, doubtful], MANY) > 0.5
    return result


def _odd_share(geometry: Geometry, points: np.ndarray, n: int) -> np.ndarray:
    """The share of n rays from each point that meet the object an odd number of times."""
    if not points.shape[1]:
        return np.zeros(0)
    along = np.random.default_rng(11).standard_normal((3, n))
    along /= np.linalg.norm(along, axis=0)
    start, ends = np.repeat(points, n, axis=1), np.tile(along, points.shape[1])
    _, count = crossings(geometry.scene, ray_of_arrays(start, ends))
    return (np.array(count) % 2).reshape(-1, n).mean(axis=1)


# --------------------------------------------------------------------------------------------------
# Scenes of single objects beside the scene that they stand in, whose rays are traced in one kernel.
#
# OptiX knows one table of shaders in a kernel. Dr.Jit does no more than log that a ray needs another one, and the ray
# then meets nothing. Mitsuba adds the shapes of a scene to the table of another that it is given at its making.


TRIALS = 256  # rays


def name_of(shape: mi.Shape) -> str:
    """The id of a shape in quotes; what it may be, where it has none."""
    if shape.id():
        return repr(shape.id())
    return "without an id (Mitsuba merges meshes of one surface; load_dict(..., optimize=False) keeps them apart)"


def _by_optix() -> bool:
    return mi.variant().startswith("cuda")


def by_pointer(pointers: Iterable[Pointer], values: Sequence[float], otherwise: float) -> mi.Int32 | mi.Float:
    """Table from the number of a pointer in Dr.Jit's registry to a whole number, or to a real one."""
    ids, whole = pointer_numbers(pointers), isinstance(otherwise, int)
    table = np.full(max(ids, default=0) + 1, otherwise)
    table[ids] = values
    # lists, not NumPy arrays: memory in any alignment would need kernels of its own
    return (mi.Int32 if whole else mi.Float)(table.tolist())


def pointer_numbers(pointers: Iterable[Pointer]) -> list[int]:
    """The number of each pointer in Dr.Jit's registry."""
    return [int(dr.reinterpret_array(mi.UInt32, pointer)[0]) for pointer in pointers]


def looked_up(table: mi.Int32, pointer: Pointer, otherwise: int, active: mi.Bool | bool = True) -> mi.Int32:
    """The value of a pointer in a table of `by_pointer`."""
    number = dr.reinterpret_array(mi.UInt32, pointer)
    known = active & (number < dr.width(table))
    return dr.select(known, dr.gather(mi.Int32, table, number, known), otherwise)


class SceneMark:
    """Tells a scene from others that the same objects may stand in; only OptiX has to know.
    Mitsuba lists the shapes of each scene in a variable, which is kept in place of the scene: that would never be
    freed, and its address is given again once it is."""

    def __init__(self, scene: mi.Scene) -> None:
        self._kept = scene.shapes_dr() if _by_optix() else mi.ShapePtr()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SceneMark):
            return NotImplemented
        return dr.detail.collect_indices(self._kept) == dr.detail.collect_indices(other._kept)


def scene_of(shapes: list[mi.Shape], world: mi.Scene | None = None) -> mi.Scene:
    """A Mitsuba scene that holds these shapes, which keep their ids.
    `world`: the scene that they stand in, if rays are traced in both by one kernel or one is an instance. It is not
    kept alive, and must not be one that this function made."""
    named = [*shapes, world] if world is not None and _by_optix() else shapes
    if world is not None and any(map(is_instance, shapes)):  # Mitsuba looks for their groups in the scene
        named = [*groups_of(world), *named]
    names = [known.id() for known in named]
    scene = mi.load_dict({"type": "scene", **{f"shape{k}": known for k, known in enumerate(named)}})
    for known, name in zip(named, names):
        known.set_id(name)
    return scene


def is_instance(shape: mi.Shape) -> bool:
    """Whether a shape shows a group of others."""
    return "nstance" in shape.class_name()


def groups_of(scene: mi.Scene) -> list[mi.Shape]:
    """The groups that instances in a scene show."""
    return [node for node in mi.traverse(scene).hierarchy if node.class_name() == "ShapeGroupPlugin"]


def ray_of_arrays(o: np.ndarray, d: np.ndarray) -> mi.Ray3f:
    """Rays from origins and directions of shape (3, n)."""
    return mi.Ray3f(*(kind(*(aligned(mi.Float, v) for v in x)) for kind, x in ((mi.Point3f, o), (mi.Vector3f, d))))


def rays_into(box: mi.ScalarBoundingBox3f, n: int) -> mi.Ray3f:
    """Rays from about a bounding box to places in it."""
    (start,), (along,) = ways_into(*box_ends(box)[:, None], n)
    return ray_of_arrays(start, along)


def ways_into(low: np.ndarray, high: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of such rays for boxes with the corners (m, 3): shapes (m, 3, n)."""
    centre, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)[:, None, None]
    rng = np.random.default_rng(7)
    ends = rng.standard_normal((2, 3, n))
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    start = centre[:, :, None] + 1.1 * radius * ends[0]
    target = centre[:, :, None] + 0.9 * radius * ends[1] * rng.random(n) ** (1 / 3)
    along = target - start
    return start, along / np.linalg.norm(along, axis=1, keepdims=True)


def lines_through(box: mi.ScalarBoundingBox3f, n: int) -> mi.Ray3f:
    """Rays along lines through the ball about a bounding box that are uniform over places and directions."""
    rng, (low, high) = np.random.default_rng(7), box_ends(box)
    d, aside = rng.standard_normal((2, 3, n))
    d /= np.linalg.norm(d, axis=0)
    aside -= (aside * d).sum(axis=0) * d
    aside *= np.sqrt(rng.random(n)) / np.linalg.norm(aside, axis=0)
    start = 0.5 * (low + high)[:, None] + 0.5 * np.linalg.norm(high - low) * (aside - 1.01 * d)
    return ray_of_arrays(start, d)


def check_together(world: mi.Scene, scenes: list[mi.Scene]) -> None:
    """Try rays in a scene and in those of objects in it by one kernel, where that may fail.
    `world`: the scene around all. `scenes`: from `scene_of`. RuntimeError if rays meet other things than by kernels of
    their own, or shapes that are not in their scene."""
    if not _by_optix():
        return

    tried = [scene for scene in (world, *scenes) if scene.bbox().valid()]
    rays = [rays_into(scene.bbox(), TRIALS) for scene in tried]
    dr.eval(rays)
    alone = [np.array(_met(scene, ray)) for scene, ray in zip(tried, rays)]
    together = [_met(scene, ray) for scene, ray in zip(tried, rays)]
    dr.eval(together)
    for scene, by_itself, beside in zip(tried, alone, map(np.array, together)):
        shapes = scene.shapes()
        if any(map(is_instance, shapes)):
            nodes = [node for group in groups_of(scene) for node in mi.traverse(group).hierarchy]
            shapes = [*shapes, *(node for node in nodes if isinstance(node, mi.Shape))]
        own = [0, *pointer_numbers(map(mi.ShapePtr, shapes))]
        if (by_itself != beside).any() or (scene is not world and not np.isin(beside, own).all()):
            raise RuntimeError(
                "rays of objects and of the scene around them must be traced by one kernel, got some lost"
            )


def _met(scene: mi.Scene, ray: mi.Ray3f) -> mi.UInt32:
    """The numbers of the shapes that rays meet in Dr.Jit's registry, 0 for none."""
    hit = scene.ray_intersect_preliminary(ray, False)
    return dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0)
