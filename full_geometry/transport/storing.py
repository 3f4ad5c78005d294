"""Weights of objects on disk, found again by the object they belong to, and their binding to it.

It is the same shape of the same size in mean free paths, wherever it stands.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.points import ObjectModel, PositionSampler, RadialTable, opaque
from full_geometry.geometry.shape import name_of
from full_geometry.geometry.snapshot import object_digest
from full_geometry.objects.objects import TranslucentObject, check_geometry
from full_geometry.settings import AUTOMATIC, Settings
from full_geometry.surface.translucent import MediumSpec
from full_geometry.surface.varying import grid_values
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.features import REFLECTIONS, ObjectFrame, n_local, n_pair, n_side, surroundings
from full_geometry.transport.half_space import HalfSpaceProposals
from full_geometry.transport.one_object import BASE_MODEL, DirectionalAlbedo, FullGeometry, HalfSpace
from full_geometry.transport.patches import AREA_SHARE, LearntProposals, Patches, PatchSampler, PatchTable
from halfspace_sss.neural.store import checksum_of, load_weights, save_weights, weights_folder
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import path_of

ANCHORS = 256
CLOSE = 1e-4  # positions over the size of the object, coefficients relative
SAMPLED = 0.05  # of the homogeneous equivalent of a medium that varies, a mean over random points
PROBED = 64  # anchors towards which a medium that varies is probed,
DEPTHS = (1.0, 0.7, 0.4)  # at these parts of their distance from the middle
LEAST_LOSS = 1e-3  # 1 - albedo below which media are alike
NEAR, MOST_FAR = 1e-2, 0.03  # of the largest coefficient; share of points, for voxels that are not interpolated


@dataclass(frozen=True, eq=False)
class Identity:
    """What tells objects apart.

    Args:
        kind: class of the shape.
        topology: checksum of its faces, and whether it has normals of its own; empty for a shape without faces.
        anchors: points that move with the shape, then those of shapes inside it, (n, 3), scene units.
        medium: per channel albedo, g and sigma_t sqrt(area), and eta; of a medium that varies its equivalent.
        grids: digest of the voxels of a medium that varies.
        probes: coefficients of a medium that varies, see `_probed`.
        contents: digest of shapes inside it, their surfaces and media, without their places.
        textures: digest of the textures of its medium, and of uv and attributes.
    """

    kind: str
    topology: str
    anchors: np.ndarray
    medium: dict[str, Any]
    grids: str = ""
    probes: np.ndarray | None = None
    contents: str = ""
    textures: str = ""

    def digest(self) -> str:
        """A name for shape, its handedness, ratios of the medium and what lies inside, without sizes and places."""
        keys = ("g", "eta") if self.grids else ("albedo", "g", "eta")  # an equivalent is known up to its sampling
        ratios = [digest for digest in (self.grids, self.contents, self.textures) if digest]
        ratios += [f"{v:.6g}" for key in keys for v in np.atleast_1d(self.medium[key])]
        return hashlib.sha256("|".join([self.kind, self.topology, self._hand(), *ratios]).encode()).hexdigest()[:12]

    def _hand(self) -> str:
        """Which of an object and its mirror image, that have the same faces and size, it is."""
        x = self.anchors.astype(float)
        x = (x - x.mean(axis=0)) / max(np.linalg.norm(np.std(x, axis=0)), 1e-30)
        turns = np.linalg.det(np.random.default_rng(0).standard_normal((3, len(x))) @ x / np.sqrt(len(x)))
        return "left" if turns < 0 else "right"

    def record(self) -> dict[str, Any]:
        """Everything but the anchors and probes, ready for JSON."""
        kept = {"kind_of_shape": self.kind, "topology": self.topology, "medium": self.medium, "grids": self.grids}
        return kept | {key: getattr(self, key) for key in ("contents", "textures") if getattr(self, key)}

    def pose(self, other: Identity) -> tuple[np.ndarray, np.ndarray]:
        """R and t with R x + t = y for the points x of this object and y of the other, which is the same one moved.
        ValueError if it is another object; says in what."""
        pairs = (
            ("kind", "shape", "without faces"), ("topology", "mesh", "without faces"), ("grids", "grids", "none"),
            ("contents", "inclusions", "nothing"), ("textures", "textures", "none"),
        )  # fmt: skip
        for key, name, none in pairs:
            mine, theirs = getattr(self, key), getattr(other, key)
            if mine != theirs:
                raise ValueError(f"{name} must be {mine or none}, as trained, got {theirs or 'none'}")
        R, t = self.moved(other)
        for key, mine in self.medium.items():
            theirs = other.medium[key]
            close = SAMPLED if self.grids else CLOSE
            if np.shape(mine) != np.shape(theirs) or not np.allclose(mine, theirs, rtol=close, atol=1e-7):
                raise ValueError(f"{key} of the medium must be {mine}, as trained, got {theirs}")
        if self.grids:
            _check_same(self.probes, other.probes)
        return R, t

    def moved(self, other: Identity) -> tuple[np.ndarray, np.ndarray]:
        """R and t of `pose` to an object that may have another medium."""
        R, t, miss = _kabsch(self.anchors.astype(float), other.anchors.astype(float))
        spread, others = (float(np.linalg.norm(np.std(v, axis=0))) for v in (self.anchors, other.anchors))
        if miss > CLOSE * spread:
            raise ValueError(
                f"object must be the one that was trained, moved and turned only, got one that differs by "
                f"{miss / spread:.2g} of its size (about {others / max(spread, 1e-30):.3g} times as large)"
            )
        return R, t


def _kabsch(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation and shift that take a to b best, and the largest distance that is left."""
    if a.shape != b.shape:
        return np.eye(3), np.zeros(3), np.inf
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    U, _, V = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))])
    R = (U @ flip @ V).T
    t = mean_b - R @ mean_a
    return R, t, float(np.linalg.norm(a @ R.T + t - b, axis=1).max())


def identify(obj: TranslucentObject) -> Identity:
    """The identity of an object as it stands."""
    topology, anchors = _anchored(obj.geometry.shape)
    media = obj.media
    medium = {key: [float(getattr(m, key)) for m in media] for key in ("albedo", "g")}
    medium |= {"size_in_mfp": obj.mean_free_paths().tolist(), "eta": float(obj.media[0].eta)}
    grids, probes = _digest_of_grids(obj), _probed(obj, anchors)
    contents, more = _contents(obj, anchors)
    anchors = np.concatenate([anchors, *more]).astype(np.float32)
    kind = obj.geometry.shape.class_name()
    return Identity(
        kind=kind, topology=topology, anchors=anchors, medium=medium, grids=grids, probes=probes, contents=contents,
        textures=_digest_of_textures(obj),
    )  # fmt: skip


def _anchored(shape: mi.Shape) -> tuple[str, np.ndarray]:
    """Topology and anchors of a shape, see `Identity`."""
    parameters = mi.traverse(shape)
    topology = ""
    if mesh.has_faces(shape):
        faces, positions = mesh.face_vertices(shape).astype(np.uint32), mesh.vertex_positions(shape).astype(float)
        smooth = "smooth" if shape.has_vertex_normals() else "flat"
        topology = f"{hashlib.sha256(faces.tobytes()).hexdigest()[:16]} {smooth}"
        anchors = positions[np.unique(np.linspace(0, len(positions) - 1, ANCHORS).astype(int))]
    elif "to_world" in parameters:
        matrix = np.array(parameters["to_world"].matrix, dtype=float).reshape(4, 4)
        if "grid" in parameters:
            topology = hashlib.sha256(np.array(parameters["grid"], dtype=np.float32).tobytes()).hexdigest()[:16]
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)
        anchors = (matrix[:3, :3] @ corners + matrix[:3, 3:]).T
    else:
        raise ValueError(
            f"{name_of(shape)} must be a mesh or have a transformation to be learnt, got a {shape.class_name()}"
        )
    return topology, anchors


def _contents(obj: TranslucentObject, anchors: np.ndarray) -> tuple[str, list[np.ndarray]]:
    """Digest of what lies inside, in an order that the order in the scene has no part in, and anchors of each.
    `anchors`: its own; of those that are alike inside, the nearest to the first of them comes first."""
    inclusions, results = obj.geometry.inclusions, []
    if inclusions is None:
        return "", []
    for shape, spec in zip(inclusions.shapes, inclusions.specs):
        topology, x = _anchored(shape)
        words = f"{shape.class_name()} {topology} {_surface(shape, spec, float(obj.media[0].sigma_t))}"
        results.append((words, float(np.linalg.norm(x - anchors[0], axis=1).sum()), x))
    results.sort(key=lambda each: each[:2])
    digest = hashlib.sha256("|".join(words for words, _, _ in results).encode()).hexdigest()[:16]
    return digest, [x for _, _, x in results]


def _surface(shape: mi.Shape, spec: MediumSpec | None, sigma_t: float) -> str:
    """Of its BSDF and colours, or of its boundary and medium; names of materials and models do not count."""
    bsdf = shape.bsdf()
    if spec is not None:
        m = spec.medium
        numbers = np.concatenate([np.ravel(v) for v in (m.albedo, m.g, m.sigma_t / max(sigma_t, 1e-30), m.eta)])
        return f"{object_digest(surface_of(shape).boundary)} {[f'{v:.6g}' for v in numbers]}"
    return f"{object_digest(bsdf)} {_painted(shape)} {mesh.is_flipped(shape)}"


def _painted(shape: mi.Shape) -> str:
    """Digest of uv and attributes."""
    painted = hashlib.sha256()
    for key, value in mesh.attributes(shape):
        painted.update(key.encode() + value.tobytes())
    return painted.hexdigest()


def _digest_of_textures(obj: TranslucentObject) -> str:
    """Empty for a medium without; what is constant, and the scale, are in the means."""
    if obj.textured is None:
        return ""
    words = [f"{name} {object_digest(texture)}" for name, texture in obj.textured.textures.items()]
    return hashlib.sha256("|".join([*words, _painted(obj.geometry.shape)]).encode()).hexdigest()[:16]


def _as_trained(obj: TranslucentObject, medium: dict[str, Any]) -> TranslucentObject:
    """The same with the homogeneous equivalent of training, see `Identity`; itself where the medium is homogeneous.
    Another equivalent, over the random points that the object has where it stands now, would be another S_0."""
    if obj.varying is None or len(medium["albedo"]) != len(obj.media):
        return obj
    known = zip(medium["albedo"], medium["size_in_mfp"], medium["g"])
    length, eta = math.sqrt(obj.geometry.area), obj.media[0].eta
    media = tuple(Medium.from_albedo(albedo, size / length, g, eta) for albedo, size, g in known)
    return replace(obj, media=media)


def _digest_of_grids(obj: TranslucentObject) -> str:
    """Of the voxels and of the ratios of what they are multiplied by; empty for a homogeneous medium."""
    medium = obj.varying
    if medium is None:
        return ""
    digest = hashlib.sha256()
    for volume in (medium.density, medium.albedo_volume):
        voxels = np.zeros(0) if volume is None else np.ascontiguousarray(grid_values(volume), dtype=np.float32)
        digest.update(str(voxels.shape).encode() + voxels.tobytes())
    ratios = (*medium.factor / medium.factor.max(), *medium.albedo)
    digest.update("|".join(f"{v:.6g}" for v in ratios).encode())
    return digest.hexdigest()[:16]


def _probed(obj: TranslucentObject, anchors: np.ndarray) -> np.ndarray:
    """sigma_t and sigma_s times sqrt(area) at points that move with the shape, (2 channels, points); none if constant.
    They tell grids that lie elsewhere in the object, or are interpolated in another way."""
    if obj.varying is None:
        return np.zeros((0, 0), dtype=np.float32)
    centre, some = anchors.mean(axis=0), anchors[:: max(len(anchors) // PROBED, 1)]
    points = np.concatenate([centre + depth * (some - centre) for depth in DEPTHS])
    values = np.concatenate(obj.varying.coefficients(mi.Point3f(points.T.astype(np.float32))))
    return (values * np.sqrt(obj.geometry.area)).astype(np.float32)


def _check_same(trained: np.ndarray, here: np.ndarray) -> None:
    """ValueError if the coefficients at the points of `_probed` are not those of training."""
    if trained.shape == here.shape:
        scale = np.abs(trained.astype(float)).max(initial=1e-30)
        gap = np.abs(trained.astype(float) - here.astype(float))
        if trained.size == 0 or np.mean(gap > NEAR * scale) <= MOST_FAR:
            return
        raise ValueError(
            "the medium must vary in the object as trained, got grids placed, scaled or interpolated in another way "
            f"(coefficients differ by up to {gap.max() / scale:.2g} of the largest)"
        )
    raise ValueError(f"coefficients must be known at {trained.shape} points, as trained, got {here.shape}")


def frame_of(obj: TranslucentObject, trained: Identity | None = None, turns: np.ndarray | None = None) -> ObjectFrame:
    """The frame of the features; that of training for an object that has been moved since.
    `trained`: as it was trained. `turns`: of its surroundings then. ValueError if the object is not the one that was
    trained."""
    here = identify(obj)
    R, t = (np.eye(3), np.zeros(3)) if trained is None else trained.pose(here)
    anchors = here.anchors if trained is None else trained.anchors
    low, high = anchors.min(axis=0).astype(float), anchors.max(axis=0).astype(float)
    centre = R @ (0.5 * (low + high)) + t
    radius = 0.5 * float(np.linalg.norm(high - low))
    each = [float(m.sigma_t) for m in obj.media]
    sigma_t = float(np.exp(np.mean(np.log(each))))
    turn = None if np.allclose(R, np.eye(3), atol=1e-6) else [mi.Vector3f(*map(opaque, row)) for row in R.T]
    frame = ObjectFrame(
        mi.Point3f(*map(opaque, centre)), opaque(radius), opaque(sigma_t), tuple(map(opaque, each)), turn
    )
    return replace(frame, around=surroundings(obj, frame, turns))


KIND = "full_geometry"
BOUND_TO = {"base_model": BASE_MODEL, "reflections": REFLECTIONS}  # what weights multiply, in their record
CENTRES, TRUSTED, TURNS, ENDS = "centres", "even", "turns", "Q"
S_LAYERS, ALPHA_LAYERS, PATCH_LAYERS = ("W_", "b_", ENDS), ("A_", "a_"), ("V_", "c_")


class Learnt(NamedTuple):
    """What weights give: the model, and the sampler of its entries, None for a shape without faces."""

    model: FullGeometry
    sampler: PatchSampler | None


def weights_name(identity: Identity) -> str:
    """File name of the weights of an object: its digest, and its size in mean free paths of the first channel.

    Where something lies inside also what tells places apart: `find_weights` asks the poses of all with the same digest.
    """
    name = f"{KIND}-{identity.digest()}-{identity.medium['size_in_mfp'][0]:.5g}"
    if identity.contents:
        size = np.linalg.norm(np.std(identity.anchors, axis=0))
        places = np.rint(identity.anchors / max(CLOSE * size, 1e-30)).astype(np.int64)
        name += f"-{hashlib.sha256(places.tobytes()).hexdigest()[:8]}"
    return f"{name}.safetensors"


def save(
    folder: str | os.PathLike[str], identity: Identity, arrays: dict[str, np.ndarray], record: dict[str, Any]
) -> Path:
    """Write the weights of an object and their record; returns the path."""
    whole = {"orders": "multiple", **BOUND_TO, **identity.record(), **record}
    bound = {"anchors": identity.anchors.astype(np.float32)}
    if identity.grids:
        bound["probes"] = identity.probes
    return save_weights(path_of(folder) / weights_name(identity), KIND, {**arrays, **bound}, whole)


def find_weights(obj: TranslucentObject, folder: str | os.PathLike[str] | None = None) -> Path:
    """The file of weights of an object.
    ValueError if there is none, which says what tells the object from the nearest one that was trained."""
    here = identify(obj)
    place = path_of(folder or weights_folder())
    reasons = []
    for path in sorted(place.glob(f"{KIND}-{here.digest()}-*.safetensors")):
        try:
            _trained(path)[0].pose(here)
            return path
        except ValueError as error:
            reasons.append(f"{path.name}: {error}")
    why = f" ({'; '.join(reasons)})" if reasons else ""
    raise ValueError(
        f"object {obj.geometry.name} must be trained for {KIND}, got one that is not in {place}{why}: "
        f"`halfspace-sss train object --scene SCENE.xml --object {obj.geometry.shape.id()}` trains it"
    )


class Neighbour(NamedTuple):
    """Weights of the same object with another medium: file, arrays, and how far the media are apart."""

    path: Path
    arrays: dict[str, np.ndarray]
    distance: float


MOST_APART = 1.0  # media of a neighbour, see `_apart`


def nearest(
    obj: TranslucentObject, recipe: Mapping[str, Any], folder: str | os.PathLike[str] | None = None
) -> Neighbour | None:
    """Weights of the same shape with the medium that is most alike, from which a training may start; None without any.
    `obj`: the object; weights are of homogeneous media with nothing inside. `recipe`: of its training; sizes must
    be those of the weights."""
    here, found = identify(obj), []
    if here.grids or here.contents or here.textures:
        return None
    for path in path_of(folder or weights_folder()).glob(f"{KIND}-*.safetensors"):
        try:
            identity, arrays, record = _trained(path)
            R, _ = identity.moved(here)
        except ValueError:
            continue
        same = identity.kind == here.kind and identity.topology == here.topology
        same = same and not (identity.contents or identity.textures)
        alike = all(record["recipe"].get(key) == recipe[key] for key in ("width", "depth"))
        apart = _apart(identity.medium, here.medium)
        if same and np.allclose(R, np.eye(3), atol=1e-3) and alike and apart <= MOST_APART:
            found.append(Neighbour(path, arrays, apart))
    return min(found, key=lambda each: (each.distance, each.path.name), default=None)


def _apart(a: dict[str, Any], b: dict[str, Any]) -> float:
    """The largest |ln| of the ratio of sizes in mean free paths and of 1 - albedo; infinite for other g and eta."""
    if len(a["albedo"]) != len(b["albedo"]) or not np.allclose([*a["g"], a["eta"]], [*b["g"], b["eta"]], rtol=CLOSE):
        return math.inf
    lost = [np.log(np.maximum(1 - np.array(m["albedo"]), LEAST_LOSS)) for m in (a, b)]
    sizes = [np.log(np.maximum(m["size_in_mfp"], 1e-30)) for m in (a, b)]
    return float(max(np.abs(np.subtract(*values)).max() for values in (lost, sizes)))


def trained(obj: TranslucentObject) -> bool:
    """Whether there are weights of an object."""
    try:
        find_weights(obj)
    except ValueError:
        return False
    return True


def _trained(path: Path) -> tuple[Identity, dict[str, np.ndarray], dict[str, Any]]:
    arrays, record = load_weights(path, KIND)
    for key, wanted in BOUND_TO.items():
        if record.get(key) != wanted:
            known = f"{key} must be {wanted}, got {record.get(key)}"
            raise ValueError(f"{path.with_suffix('.json')}: {known}: of another version, to be trained again")
    if missing := sorted({TRUSTED, TURNS, ENDS} - arrays.keys()):
        raise ValueError(f"{path}: arrays must hold {', '.join(missing)}, got none: to be trained again")
    try:
        anchors, grids = arrays.pop("anchors"), record.get("grids", "")
        probes = arrays.pop("probes") if grids else None
        kind, topology, medium = record["kind_of_shape"], record["topology"], dict(record["medium"])
        more = (record.get(key, "") for key in ("contents", "textures"))
        identity = Identity(kind, topology, anchors, medium, grids, probes, *more)
        if {"albedo", "g", "eta", "size_in_mfp"} - set(identity.medium):
            raise KeyError("medium")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path.with_suffix('.json')}: record must describe an object, {error} is wrong") from error
    return identity, arrays, record


def load(path: str | os.PathLike[str], obj: TranslucentObject) -> Learnt:
    """The model of an object and its sampler from its weights.

    Raises:
        ValueError: the file is damaged, of another kind or version, or of another object.
    """
    path = Path(path)
    identity, arrays, record = _trained(path)
    try:
        obj = _as_trained(obj, identity.medium)
        frame = frame_of(obj, identity, arrays[TURNS])
        first, bias = ALPHA_LAYERS
        units = arrays[f"{first}{max(sum(name.startswith(bias) for name in arrays) - 1, 0)}"].shape[1]
        channels, known = len(obj.media), arrays["W_0"].shape[1]
        n = 2 * (n_side(channels, n_local(obj)) + units) + n_pair(channels)
        if n != known:
            raise ValueError(f"W_0 must have {n} inputs, got {known}: of another version, to be trained again")
    except KeyError as error:
        raise ValueError(f"{path}: layers must be those of {KIND}, {error} is missing") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return assemble(obj, frame, HalfSpace(obj, BASE_MODEL), arrays)


def assemble(
    obj: TranslucentObject,
    frame: ObjectFrame,
    base: HalfSpace,
    arrays: Mapping[str, np.ndarray],
    patches: Patches | None = None,
) -> Learnt:
    """Model and sampler from the arrays of a file; `patches` are made from their centres if they are not given."""

    def layers(names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return {name: value for name, value in arrays.items() if name.startswith(names)}

    alpha = DirectionalAlbedo(obj, frame, layers(ALPHA_LAYERS), arrays[TRUSTED])
    model = FullGeometry(obj, frame, base, layers(S_LAYERS), alpha)
    if CENTRES not in arrays:
        return Learnt(model, None)
    patches = patches or Patches(obj, frame, arrays[CENTRES].astype(np.float32))
    return Learnt(model, PatchSampler(frame, patches, layers(PATCH_LAYERS)))


# --------------------------------------------------------------------------------------------------
# Binds what was trained of an object: its transport, and entries drawn by patches and probes.


FINE = 2.5  # transport mean free paths of the radius of a patch, up to which patches do without probes
PATCH_SHARE = 0.2  # of the entries where patches are larger: they reach what probes miss
ENTRIES = 2  # of an exit: its own work is done once, and patches draw without a ray


def learnt_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """Transport and proposals of an object that was trained.
    ValueError if the object cannot be trained or was not, which says the command that trains it; or weights are
    damaged."""
    geometry = obj.geometry
    check_geometry(geometry)
    path = find_weights(obj)
    model, sampler = load(path, obj)
    backbone = model.base.models
    transport = replace(model, checksums=(checksum_of(path, KIND),))
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], geometry.size)
    by_itself = AREA_SHARE if sampler is None else 0.0  # patches reach everywhere
    share = by_itself if settings.area_share == AUTOMATIC else settings.area_share
    positions = PositionSampler(replace(geometry, pieces=None), table, obj.points, share)
    if sampler is None:
        return ObjectModel(transport, HalfSpaceProposals(positions, backbone[0]))
    radius = np.sqrt(geometry.area / (np.pi * sampler.patches.n))
    sigma_t_prime = np.mean([float(m.sigma_t_prime) for m in obj.media])
    patch_share = 1.0 if radius * sigma_t_prime < FINE else PATCH_SHARE
    proposals = LearntProposals(sampler, positions, patch_share, geometry.sign, PatchTable(sampler))
    return ObjectModel(transport, proposals, ENTRIES)
