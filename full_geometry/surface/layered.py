"""Media in layers below a surface, as skin has them: which layer a point is in, its depth below the surface tells.

    sigma_t(x) = sigma_t,k,  albedo(x) = albedo_k,    D_k <= d(x) < D_{k+1},

d the distance to the nearest point of the surface and D_k the sum of the thicknesses above layer k. Depths are known at
the nodes of a grid, about the nearest of many points p of the surface with normals n,

    d = max(|n.(x - p)|, sqrt(|x - p|² - e²)),

e the distance of these points; the first is exact below faces, the second below edges that point inwards. Between
nodes depths are linear, which is exact below a plane and off by H² / (8 R) below a sphere of radius R, H the distance
of nodes. All layers have one index and mean cosine: no light is reflected between them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.spatial import cKDTree

from full_geometry.geometry.light_points import lattice, uniform_entries
from full_geometry.geometry.points import floats, opaque
from full_geometry.geometry.shape import Geometry
from full_geometry.surface.varying import VaryingMedium
from halfspace_sss import materials
from halfspace_sss.materials.tissues import MELANOSOMES
from halfspace_sss.physics.medium import Medium

NODES = 128  # of the grid along the longest side of an object
POINTS = 2**18  # of the surface
SKIN = "skin "
STEPS = 400  # of the mean over depths
LEAST_DECAY = 0.05  # of sigma_t', where nothing absorbs


@dataclass(frozen=True, eq=False)
class LayeredMedium(VaryingMedium):
    """Layers before the object is known that they are of; of its base class it is the first layer everywhere.
    `media`: of the layers, with one value for each channel, 1/mm; of one g and eta. `thickness`: of all layers but the
    last, mm."""

    media: tuple[Medium, ...] = ()
    thickness: tuple[float, ...] = ()
    by_depth = True

    @classmethod
    def of(cls, media: tuple[Medium, ...], thickness: tuple[float, ...]) -> LayeredMedium:
        """ValueError if indices or mean cosines of the layers differ."""
        first = media[0]
        for k, medium in enumerate(media[1:], 2):
            if medium.eta != first.eta or not np.array_equal(medium.g, first.g):
                raise ValueError(
                    f"layers must have one g and eta, got g {medium.g} and eta {medium.eta:g} of layer {k}, "
                    f"g {first.g} and eta {first.eta:g} of the first"
                )
        return cls(None, np.atleast_1d(first.sigma_t), None, np.atleast_1d(first.albedo), media, thickness)

    def mean(self) -> Medium:
        """The homogeneous medium that stands for the layers where only one is taken. sigma_s and sigma_a are means over
        the depth z with the weight exp(-2 ∫_0^z sigma_eff dz'), the square of how much light of a diffuse field gets
        there: sigma_eff² = 3 sigma_a sigma_t', and at least a twentieth of sigma_t'."""
        rows = {key: np.array([np.atleast_1d(getattr(m, key)) for m in self.media]) for key in COEFFICIENTS}
        decay = np.sqrt(3 * rows["sigma_a"] * rows["sigma_t_prime"])
        decay = np.maximum(decay, LEAST_DECAY * rows["sigma_t_prime"])
        below = np.cumsum((0.0, *self.thickness))
        # steps that grow from a hundredth of the first layer to where the last one is dark
        z = np.geomspace(below[1] / 100, below[-1] + 8 / decay[-1].min(), STEPS) - below[1] / 100
        middle, h = 0.5 * (z[1:] + z[:-1]), np.diff(z)
        layer = np.searchsorted(below[1:], middle, side="right")
        weight = np.exp(-2 * (np.cumsum(decay[layer] * h[:, None], axis=0) - 0.5 * decay[layer] * h[:, None]))
        weight *= h[:, None]
        means = {key: (weight * rows[key][layer]).sum(axis=0) / weight.sum(axis=0) for key in COEFFICIENTS[:2]}
        first = self.media[0]
        if first.n_channels is None:
            means = {key: float(value[0]) for key, value in means.items()}
        return Medium(**means, g=first.g, eta=first.eta)

    def placed(self, obj: Geometry, mm_per_unit: float) -> VaryingMedium:
        depths = depths_of(obj, sum(self.thickness) / mm_per_unit)
        below = tuple((np.cumsum(self.thickness) / mm_per_unit).tolist())
        sigma_t, albedo = (
            np.array([np.atleast_1d(getattr(m, key)) for m in self.media]) for key in ("sigma_t", "albedo")
        )
        ones = np.ones(sigma_t.shape[1])
        return VaryingMedium(
            LayerVolume(depths, below, mm_per_unit * sigma_t), ones, LayerVolume(depths, below, albedo), ones
        )

    def __str__(self) -> str:
        above = (f"{medium} to {d:g} mm" for medium, d in zip(self.media, np.cumsum(self.thickness)))
        return "; ".join((*above, str(self.media[-1])))


COEFFICIENTS = ("sigma_s", "sigma_a", "sigma_t_prime")


def read_layers(text: str) -> tuple[tuple[Medium, ...], tuple[float, ...]]:
    """Media and thicknesses (mm) of "NAME THICKNESS, ..., NAME", names of materials, or of "skin III" (I to VI).
    ValueError if there is no such material, or a thickness that is missing, no number or not above 0."""
    if text.startswith(SKIN) and "," not in text:
        kind = text.removeprefix(SKIN).strip()
        if kind not in MELANOSOMES:
            raise ValueError(f"layers must be skin of the types {', '.join(MELANOSOMES)}, got {text!r}")
        skin = materials.skin(kind)
        return (skin.epidermis.to_rgb().medium, skin.dermis.to_rgb().medium), (skin.thickness,)
    *above, last = (part.strip() for part in text.split(","))
    if not above:
        raise ValueError(f"layers must be NAME THICKNESS, ..., NAME with two or more names, got {text!r}")
    media, thickness = [], []
    for part in above:
        name, _, number = part.rpartition(" ")
        try:
            thickness.append(float(number))
        except ValueError:
            raise ValueError(f"layers must have a thickness (mm) behind each name but the last, got {part!r}") from None
        if not 0 < thickness[-1] < np.inf:
            raise ValueError(f"layers must have thicknesses that are finite and > 0 (mm), got {part!r}")
        media.append(materials.load(name).medium)
    return (*media, materials.load(last).medium), tuple(thickness)


@dataclass(frozen=True, eq=False)
class Depths:
    """Depths below the surface of an object, on a grid.
    `texture`: of the depths, in scene units. `low`: the first node. `per_unit`: texture coordinates per scene unit
    along each axis. `half`: half a texel of each axis."""

    texture: mi.Texture3f
    low: np.ndarray
    per_unit: np.ndarray
    half: np.ndarray

    def at(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float:
        """The depth at points; outside of the object it is below 0."""
        u = [(p[k] - opaque(self.low[k])) * opaque(self.per_unit[k]) + opaque(self.half[k]) for k in range(3)]
        return self.texture.eval(mi.Point3f(*u), active)[0]


_KNOWN: WeakKeyDictionary[Geometry, tuple[float, Depths]] = WeakKeyDictionary()


def depths_of(obj: Geometry, deepest: float) -> Depths:
    """Depths of an object, correct up to `deepest` (scene units) and beyond it below that; made once.
    ValueError if the surface is not closed, or of unknown area."""
    if obj in _KNOWN and _KNOWN[obj][0] >= deepest:
        return _KNOWN[obj][1]
    if not obj.closed:
        raise ValueError(f"object {obj.name} must be closed to have layers below its surface")
    # ---- points of the surface
    u = [floats(v) for v in lattice(POINTS)]
    at = uniform_entries(obj, u[0], mi.Point2f(u[1], u[2]))
    p, n = (np.array(v, dtype=float).T for v in (at.p, at.n))
    e = float(np.sqrt(obj.area / POINTS))

    # ---- nodes within three cells of the surface, and the point nearest to each
    box = np.array([p.min(axis=0), p.max(axis=0)])
    H = float(np.ptp(box, axis=0).max()) / (NODES - 3)
    count = np.ceil(np.ptp(box, axis=0) / H).astype(int) + 3
    low = box.mean(axis=0) - 0.5 * H * (count - 1)
    shell = np.zeros(count, dtype=bool)
    shell[tuple(np.rint((p - low) / H).astype(int).T)] = True
    shell = maximum_filter(shell, 5)
    nearest = np.zeros(count, dtype=int)
    nearest[shell] = cKDTree(p).query(low + H * np.argwhere(shell))[1]

    # ---- the others take the point of the nearest of these; beyond the layers all is one depth
    place = distance_transform_edt(~shell, return_distances=False, return_indices=True)
    nearest = nearest[tuple(place)]
    way = p[nearest] - (low + H * np.moveaxis(np.indices(count), 0, -1))
    across = np.einsum("xyzk,xyzk->xyz", n[nearest], way)
    beside = np.sqrt(np.maximum(np.square(way).sum(axis=-1) - e * e, 0))
    depth = np.minimum(np.maximum(beside, np.abs(across)), deepest + 2 * H) * np.where(across < 0, -1, 1)

    # ---- as a texture, whose texels are (z, y, x)
    values = depth.transpose(2, 1, 0)[..., None]
    texture = mi.Texture3f(mi.TensorXf(floats(values), values.shape), use_accel=False, wrap_mode=dr.WrapMode.Clamp)
    result = Depths(texture, low, 1 / (H * count), 0.5 / count)
    _KNOWN[obj] = deepest, result
    return result


@dataclass(frozen=True, eq=False)
class LayerVolume:
    """A coefficient by layers, which is asked as a volume of Mitsuba.
    `depths`: of the object. `below`: depths at which the layers but the first begin, scene units. `values`: (layers,
    channels)."""

    depths: Depths
    below: tuple[float, ...]
    values: np.ndarray
    tables: list[list[mi.Float]] = field(init=False)

    def __post_init__(self) -> None:
        tables = [[mi.Float([float(v)]) for v in row] for row in self.values]
        dr.make_opaque(tables)
        object.__setattr__(self, "tables", tables)

    def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
        """The value of the layer that a point is in."""
        depth = self.depths.at(it.p, active)
        result = mi.Spectrum(self.tables[0])
        for top, row in zip(self.below, self.tables[1:]):
            result = dr.select(depth < opaque(top), result, mi.Spectrum(row))
        return result
