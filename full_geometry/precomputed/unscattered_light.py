"""Light that reaches the inside of objects unscattered, precomputed on a grid.

Under a refracting boundary a walk from the camera meets light where it leaves, by chance. The radiance L_0 that arrives
at a point inside before it has scattered needs no chance: rays from the emitters, refracted at the surface and
reflected inside, bring it to the cells of a grid, once for an image. A walk then adds at each of its events

    weight ∫ p(w.w') L_0(x, w') dw',

and drops the emitters that it meets after its last event as long as it has met nothing but the boundary of the object
since, as the grid holds their light. Where objects lie in others and nothing overlaps, rays go on from one to another,
and walks may meet these boundaries too. Light that comes by way of other surfaces, of those inside the object too, or
through another part of the object, stays to be met by chance.

Rays begin at points uniform over the surface, each with one sample of the emitters. Along a ray six points are drawn by
the transmittance, each channel in turn (balance heuristic), and added to the moments of L_0 in their cells. The fit in
each cell is linear, by least squares over the part inside (`inside_cells`): it keeps the light of a cell and its first
moments, so that its error in an image is of second order in the size of cells.

Directions of that light are held by its flux and second moments, of each cell and channel over its fluence phi:

    f = ∫ L_0 w' dw' / phi,    M = ∫ L_0 w' w'^T dw' / phi,
    ∫ p(w.w') L_0(x, w') dw' = phi(x) / (4 pi) (q_0 + 3 q_1 w.f + 5/2 q_2 (3 w^T M w - 1)).

This is exact for phase functions of three Legendre coefficients q_l. Others are split (`forward_scattering`): L_0 then
is light that has met forward events alone, and rays go on through those. Where a medium has textures, so that each walk
takes its own, rays cannot do that: phase functions are cut after q_2 = g² instead, and MOST_TRUNCATED bounds g.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import corners, ends_of
from full_geometry.geometry.points import EntrySample, opaque, sided
from full_geometry.precomputed.forward_scattering import kept_forward, quadratic_part, split_extinction, truncated
from full_geometry.precomputed.inside_cells import RIDGE, CellIndex, InsideCells, cell_edge
from full_geometry.precomputed.lit_points import bend, entries, lit_points, multiples, to_world
from full_geometry.precomputed.scattered_light import ScatteredLight, adjoint
from full_geometry.precomputed.transport_matrix import R_2
from full_geometry.walk.emission import MOST_SURVIVAL
from full_geometry.walk.media import WalkMedia
from full_geometry.walk.random_walk import Event, fly, free_path, pick, sample_bsdf, turn
from halfspace_sss.interrupts import checkpoint
from halfspace_sss.physics.medium import Medium
from halfspace_sss.tracing.walk import generator, pass_seed

EDGE, FORWARD_EDGE = 0.9, 0.6  # of cells, mean free paths of the light in them
ACROSS, FINE_CELLS = 8, 2**16  # cells along the mean chord of an object, where they are so few inside
MOST_EDGE = 1.5  # beyond, the mean of an image is more than .5 % off
DEPTHS = 3.6, 9.0  # mean free paths below the surface, at which cells are coarse and end: e^-9 is left of light there
ALONG, FORWARD_ALONG = 6, 1  # points on a segment of a ray; forward events part it into many
FEWEST_POINTS, MOST_POINTS = 2**14, 2**18  # of the surface that find its cells, of all and at once
MOST_INTEGER = 2**15 - 1  # of 16 bits, for a direction of 1
CLEAR = 1.5  # mean free paths
MOST_BENT = math.radians(35)  # of 29 light was within .5 %, of 38 to 55 it was 1 to 5 % too bright
MOST_TRUNCATED = 0.1  # abs(g) beside textures of media: at 0.3 and 0.5 light under a lamp was 2 to 3 % off
FEWEST_PATHS, RAYS_PER_PATH = 2**14, 4  # of scattered light from each object, if it has so many rays for each
MOST_RAYS, AT_ONCE = 2**24, 2**20  # of an object; an interrupt is heard between the latter
ROULETTE = 0.1  # part of its light below which a reflected ray may end


class ImageSamples(NamedTuple):
    """Samples of all pixels of an image that light is precomputed for, and its pixels."""

    samples: int
    pixels: int


class RaysPerSample(NamedTuple):
    """How many rays or paths of light are traced for each sample of an image.

    Rays are shared by cells, samples by pixels. With times t and variances V / number of a ray in a cell and of a walk
    in a pixel, an image has least noise in a time by

        rays / samples = sqrt(cells V_ray t_walk / (pixels V_walk t_ray)) = factor sqrt(cells / pixels).

    `factor`: by the time to an error of denoised images of 11 objects of 3 000 to 66 000 cells, 512 x 512 pixels; a
    quarter of a ray and of a path for all took 1 to 1.5 times as long. `least`, `most`: of a sample.
    """

    factor: float
    least: float
    most: float

    def of(self, image: ImageSamples, cells: int) -> int:
        """Rays or paths of an image."""
        share = self.factor * math.sqrt(cells / image.pixels)
        return int(image.samples * min(max(share, self.least), self.most))


RAYS, PATHS = RaysPerSample(1.0, 1 / 8, 1 / 2), RaysPerSample(0.6, 1 / 16, 1 / 4)
FORWARD_RAYS = RaysPerSample(0.5, 1 / 32, 1 / 4)  # each takes longer, by its forward events


@dataclass(frozen=True, eq=False)
class UnscatteredLight:
    """Unscattered light inside the objects of a scene.

    Args:
        index: of the cells of all objects, one after the other.
        fluence: of each slot and channel ∫ phi (1, x, y, z) dx, x from the centre of the cell by its edge.
        directions: of each slot and channel f_x, f_y, f_z, M_xx, M_yy, M_xy, M_xz, M_yz in 16 bits each; None where all
            media scatter evenly.
        scattered: of each slot and channel the same as `fluence` of light that has scattered, see `scattered_light`;
            None where that is left to walks.
        tables: by the number of an object, where its bricks begin, their corner, 1/h and counts.
        forward: whether it has met forward events, see `forward_scattering`.
        clear: whether light that is reflected inside leaves an object unscattered, which hardly reaches the next
            boundary of others.
    """

    index: CellIndex
    fluence: mi.Float
    directions: mi.UInt32 | None
    tables: dict[str, Any]
    forward: bool
    clear: bool
    scattered: mi.Float | None = None

    def light(self, media: WalkMedia, event: Event, last: mi.Bool | bool = False) -> tuple[mi.Spectrum, mi.Bool]:
        """Light that an event of a walk scatters on along it, per weight of the walk, and whether a cell holds it.
        `last`: whether scattered light counts too."""
        # ---- find the cell of the event
        at = dr.gather(dict, self.tables, media.place_of(event.object))
        x = mi.Point3f((event.p - at["low"]) * at["scale"])
        slot, y, inverse, held = self.index.find(x, at["first"], at["counts"])

        # ---- evaluate the fluence there, phi(y) = (D_0 + 12 / (1 + RIDGE) D.y) / edge³
        n, y, inverse = len(mi.Spectrum(0)), y * (12 / (1 + RIDGE)), inverse * at["scale"]
        rows = [dr.gather(mi.Vector4f, self.fluence, mi.UInt32(slot * n + c), held) for c in range(n)]
        if self.scattered is not None:
            rows = [row + dr.gather(mi.Vector4f, self.scattered, mi.UInt32(slot * n + c), held & last)
                    for c, row in enumerate(rows)]  # fmt: skip
        phi = mi.Spectrum([v.x + v.y * y.x + v.z * y.y + v.w * y.z for v in rows])
        phi *= inverse * dr.square(inverse) / (4 * dr.pi)
        if self.directions is None:
            return phi, held

        # ---- q_0 + 3 q_1 w.f + 5/2 q_2 (3 w^T M w - 1), w^T M w by the trace of 1
        x, y, z = event.along.x, event.along.y, event.along.z
        result = []
        for c, g in enumerate(event.m.g):
            packed = dr.gather(mi.Vector4u, self.directions, mi.UInt32(slot * n + c), held)
            a, b = (mi.Vector4f(mi.Vector4i(v) >> 16) / MOST_INTEGER for v in (packed << 16, packed))
            squares = a.w * (x * x - z * z) + b.x * (y * y - z * z) + z * z
            squares += 2 * (b.y * x * y + b.z * x * z + b.w * y * z)
            q_0, q_1, q_2 = quadratic_part(g) if self.forward else truncated(g)
            J = q_0 + 3 * q_1 * (a.x * x + a.y * y + a.z * z) + 2.5 * q_2 * (3 * squares - 1)
            result.append(phi[c] * J)
        return mi.Spectrum(result), held


def unscattered_light(
    scene: mi.Scene, media: WalkMedia, seed: int, cells: list[InsideCells], image: ImageSamples,
    fewest: int, scatters: bool = False,
) -> UnscatteredLight:  # fmt: skip
    """Light of the emitters of a scene inside its objects.

    Args:
        scene, media: of Mitsuba, and its objects.
        seed: of all rays and paths.
        cells: of the objects, from `inside_cells_of`.
        image: that the light is for.
        fewest: rays of each object.
        scatters: whether the cells hold scattered light too, which is left to walks otherwise.
    """
    # ---- trace light into the cells of all objects
    n = len(mi.Spectrum(0))
    directional = any(np.any(inside.medium.g) for inside in media.specs)
    index, tables = _in_one_table(cells)
    sizes = [4 * n, 8 * n] if directional else [4 * n]
    whole = [dr.zeros(mi.Float, size * sum(grid.slots for grid in cells)) for size in sizes]
    tracer = _Rays(scene, media, index, tables, whole[0], whole[1] if directional else None, forward(media))
    effort = FORWARD_RAYS if tracer.forward else RAYS
    rays = [min(max(effort.of(image, grid.slots), fewest), MOST_RAYS) for grid in cells]
    for k, number in enumerate(rays):
        tracer.trace(k, number, seed)

    # ---- fit the fluence and directions of each
    first, fluence, directions = 0, [], []
    for grid in cells:
        D, *w = (_part(values, size * first, size * grid.slots) for values, size in zip(whole, sizes))
        first += grid.slots
        grid.share(D, 4 * n, moments=True)
        if directional:
            grid.share(w[0], 8 * n)
            directions.append(_directions(w[0], D))
        grid.fit(D)
        fluence.append(D)
    light = _joined(fluence), _joined(directions) if directional else None
    dr.make_opaque(light)
    found = UnscatteredLight(index, *light, tables, forward(media), _clear(media, cells))
    if scatters:
        paths = PATHS.of(image, sum(grid.slots for grid in cells))
        found = _with_paths(scene, media, seed, found, cells, paths, min(FEWEST_PATHS, min(rays) // RAYS_PER_PATH))
    dr.sync_thread()  # callers time this
    return found


def _clear(media: WalkMedia, cells: list[InsideCells]) -> bool:
    """Whether the mean chord of an object is below CLEAR mean free paths of a channel."""
    specs = [media.specs[kind] for kind in media.instance_table.kind]
    return any(grid.chord * media.mm_per_unit * np.min(spec.medium.sigma_t) < CLEAR for grid, spec in zip(cells, specs))


def _in_one_table(cells: list[InsideCells]) -> tuple[CellIndex, dict[str, Any]]:
    """The index of the cells of all objects, one after the other, and the tables of `UnscatteredLight`."""
    bricks, slots = [], []
    rows: dict[str, list] = {"first": [], "low": [], "scale": [], "counts": []}
    bricks_before, cells_before, slots_before = 0, 0, 0
    for grid in cells:
        brick, slot = grid.index.brick, grid.index.slot
        bricks.append(dr.select(brick >= 0, brick + dr.opaque(mi.Int32, 2 * cells_before), -1))
        slots.append(dr.select(slot >= 0, slot + dr.opaque(mi.Int32, slots_before), -1))
        about = {"first": bricks_before, "low": grid.low, "scale": float(1 / grid.h), "counts": grid.counts}
        for key, value in about.items():
            rows[key].append(value)
        bricks_before, cells_before = bricks_before + dr.width(brick), cells_before + dr.width(slot)
        slots_before += grid.slots
    # lists are copied; the memory of NumPy would be taken over, and its chance alignment is in the code of kernels
    tables = {key: kind(rows[key]) for key, kind in (("first", mi.Int32), ("scale", mi.Float))}
    tables["low"] = mi.Point3f(*(mi.Float([float(v) for v in axis]) for axis in np.transpose(rows["low"])))
    tables["counts"] = mi.Vector3i(*(mi.Int32([int(v) for v in axis]) for axis in np.transpose(rows["counts"])))
    index = CellIndex(_joined(bricks), _joined(slots))
    dr.make_opaque(tables, index)
    return index, tables


def _with_paths(
    scene: mi.Scene, media: WalkMedia, seed: int, light: UnscatteredLight, cells: list[InsideCells], paths: int,
    fewest: int,
) -> UnscatteredLight:  # fmt: skip
    """Light with the fit of what paths from the emitters bring to the cells of all objects, see `scattered_light`.
    `fewest`: paths from each."""
    # ---- paths from all objects, which pass from one to another
    n, slots = 4 * len(mi.Spectrum(0)), sum(grid.slots for grid in cells)
    D = dr.zeros(mi.Float, 2 * n * slots)
    dr.eval(D)
    tracer = ScatteredLight(scene, media, light.index, light.tables, D, slots)
    # by the flux that reaches each object or piece of glass, where there are several
    starts = media.lit_from_outside
    flux = np.array([tracer.flux(k, seed) for k in starts] if len(starts) > 1 else [1.0])
    for k, share in zip(starts, flux / max(flux.sum(), 1e-30)):
        tracer.trace(k, max(int(share * paths), fewest), seed)

    # ---- the fit of each: L_s, then L_u, which has not scattered
    parts, first = [], 0
    for grid in (*cells, *cells):
        part = _part(D, first, n * grid.slots)
        first += n * grid.slots
        grid.share(part, n, moments=True)
        grid.fit(part)
        parts.append(part)
    scattered, others = _joined(parts[: len(cells)]), light.fluence + _joined(parts[len(cells) :])
    dr.make_opaque(scattered, others)
    return replace(light, fluence=others, scattered=scattered)


def _part(values: mi.Float, first: int, number: int) -> mi.Float:
    """So many of the values from `first` on: no copy if they are all."""
    if number == dr.width(values):
        return values
    result = dr.gather(mi.Float, values, dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, number))
    dr.eval(result)
    return result


def _joined(parts: list) -> Any:
    return parts[0] if len(parts) == 1 else dr.concat(parts)


def _directions(w: mi.Float, D: mi.Float) -> mi.UInt32:
    """f and M of the light of cells, over that of all cells that share a fit, in 16 bits each.

    Args:
        w: (slots, channels, 8) ∫ L_0 w dw dx, and likewise w_x², w_y², w_x w_y, w_x w_z, w_y w_z.
        D: (slots, channels, 4) of which the first is ∫ L_0 dw dx.
    """
    lanes = dr.arange(mi.UInt32, dr.width(D) // 4)
    light = dr.gather(mi.Float, D, 4 * lanes)
    # where emitters have negative texels, moments are no longer those of a distribution
    scale = dr.select(light > 1e-30, MOST_INTEGER / light, 0)
    rows = [dr.gather(mi.Vector4f, w, 2 * lanes + i) * scale for i in range(2)]
    a, b = (mi.Vector4i(dr.round(dr.clip(row, -MOST_INTEGER, MOST_INTEGER))) for row in rows)
    result = dr.ravel(mi.Vector4u((a & 0xFFFF) | (b << 16)))
    dr.eval(result)
    return result


def obstacle(media: WalkMedia) -> str:
    """Why light of a scene must be sampled; "" where it can be precomputed."""
    if mi.is_spectral:
        return f"the variant {mi.variant()} has no light by channel"
    if media.inner is not None:
        try:
            media.holes  # noqa: B018
        except ValueError as error:
            return f"inside an object {error}"
    for obj, inside, around in zip_longest(media.objects, media.specs, media.wrappings):
        if not obj.closed:
            return f"object {obj.name} is not closed"
        if obj.bend_of_normals > MOST_BENT:
            return (
                f"normals of object {obj.name} are bent by {math.degrees(obj.bend_of_normals):.0f} degrees on average, "
                f"above {math.degrees(MOST_BENT):.0f}, as on a cube with smooth shading"
            )
        if inside.textured is not None and "sigma_t" not in inside.textured.constants:
            return f"sigma_t of object {obj.name} has a texture, and each walk takes its own value"
        if around is not None and (around.mixes or around.bend is not None):
            return f"the surface of object {obj.name} is masked, blended, or has a normal or bump map"
        if inside.orders != "total":
            return f"orders of object {obj.name} are {inside.orders!r}"
        if not forward(media) and np.max(np.abs(inside.medium.g)) > MOST_TRUNCATED:
            return f"abs(g) of object {obj.name} is above {MOST_TRUNCATED} in a scene with textures of media"
    for k, kind in enumerate(media.instance_table.kind):
        h = _grid(media, k)[1] * float(np.mean(_extinction(media, media.specs[kind].medium)))
        if h > MOST_EDGE:
            return f"object {media.objects[kind].name} is so many mean free paths wide that cells have {h:.2g}"
    return ""


def holds_scattered(media: WalkMedia) -> bool:
    """Whether cells can hold scattered light: media are even in direction and in space and not of each walk, and no
    light shines inside objects.

    Where scattering is forward it does not pay: paths of light have five times the events at g = 0.8. To equal noise
    of pixels images would take 0.6 of the time, of means over 8 x 8 pixels, which bind denoised images, 1.2 to 1.5
    times (a ball of 100 mean free paths under windows).
    """
    even = not (media.varies or media.carried) and not any(np.any(spec.medium.g) for spec in media.specs)
    return even and not (media.inner is not None and media.inner.shines)


def inside_cells_of(
    media: WalkMedia, before: WalkMedia | None = None, cells: Sequence[InsideCells] = ()
) -> list[InsideCells]:
    """The cells of all objects: those of `before` if it is of the same scene and they are as large."""
    results, same = [], before is not None and before.scene is media.scene
    for k in range(len(media.instance_table.kind)):
        box, h, depths = _grid(media, k)
        if same and _grid(before, k)[1:] == (h, depths):
            results.append(cells[k])
            continue
        area, volume = _extent(media, k)
        points = partial(_surface_points, media, k, area)
        results.append(InsideCells.of(media, k, points, box, h, depths, 4 * volume / area))
    return results


def _grid(media: WalkMedia, k: int) -> tuple[tuple[np.ndarray, np.ndarray], float, tuple[float, float]]:
    """The box of object k, the edge of its cells, and the depths beyond which they are coarse and end, scene units."""
    kind = media.instance_table.kind[k]
    low, high = ends_of(corners(media.objects[kind].scene.bbox(), to_world(media, k)[None]))
    edge, extinction = FORWARD_EDGE if forward(media) else EDGE, _extinction(media, media.specs[kind].medium)
    varying, least = media.specs[kind].varying, extinction
    if varying is not None:  # of grids, light may reach any depth
        least = np.array([_extinction(media, each) for each in varying.media]) if varying.by_depth else np.zeros(1)
    depths = tuple(np.divide(DEPTHS, np.min(least)).tolist()) if np.min(least) > 0 else (np.inf, np.inf)
    box, (area, volume) = (low[0], high[0]), _extent(media, k)
    # thin objects have finer cells: of .9 mean free paths they left 2 % RMS of bias in images of a blob of 5.4
    fine = max(4 * volume / (area * ACROSS), (volume / FINE_CELLS) ** (1 / 3))
    h = min(edge / float(np.mean(extinction)), fine or np.inf)
    return box, cell_edge(box, (area, volume), h, depths), depths


def _extent(media: WalkMedia, k: int) -> tuple[float, float]:
    """Area and volume of object k, from points of its surface."""
    at = next(_surface_points(media, k, 1, 2**12))
    height = dr.sum((at.p - mi.Point3f(at.p.x[0], at.p.y[0], at.p.z[0])) * at.n)
    area, sums = (float(np.mean(np.array(at.weight * v))) for v in (mi.Float(1) + 0 * height, height))
    return area, abs(sums) / 3


def _surface_points(media: WalkMedia, k: int, area: float, density: float) -> Iterator[EntrySample]:
    """Points over the surface of object k in order along its faces, of this density, by parts of MOST_POINTS."""
    n = max(density * area, FEWEST_POINTS)
    parts = math.ceil(n / MOST_POINTS)
    width = math.ceil(n / parts)
    for part in range(parts):
        u = (dr.arange(mi.Float, width) + 0.5) * opaque(1 / (width * parts)) + opaque(part / parts)
        yield entries(media, k, [dr.minimum(u, 1 - 2**-24), *multiples(R_2, (0.5, 0.5), width, part * width)])


def _extinction(media: WalkMedia, medium: Medium) -> np.ndarray:
    """Of the light that is precomputed in a medium, by channel, 1/(scene unit)."""
    return media.mm_per_unit * (split_extinction(medium) if forward(media) else np.atleast_1d(medium.sigma_t))


def forward(media: WalkMedia) -> bool:
    """Whether rays of light go on through forward events: some medium is uneven in direction, none of each walk."""
    return not media.carried and any(np.any(spec.medium.g) for spec in media.specs)


@dataclass
class _Ray:
    """Loop variables of a ray of light inside an object."""

    object: mi.Int32
    o: mi.Point3f
    d: mi.Vector3f
    off: mi.Vector3f  # from o to where the ray is clear of the surface
    flux: mi.Spectrum  # where it entered, times reflectances since, and albedo and 1 - q of forward events
    T: mi.Spectrum  # transmittance since it entered; 1 where flights are drawn
    entered: mi.Float  # flux at the entry, of the brightest channel
    channel: mi.UInt32  # by which flights are drawn
    density: mi.Spectrum  # of the flights so far by each channel, over the mean
    alive: mi.Bool
    rng: mi.PCG32
    within: mi.UInt32 | tuple[()] = ()  # what is around it, where things overlap, see `walk.priorities`


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays that bring the light of emitters to the cells of objects.

    Args:
        scene, media: of Mitsuba, and its objects.
        index, tables: of the cells of all objects, as of `UnscatteredLight`.
        D: ∫ L_0 x_j dx dw over the inside of each cell by channel, x about its centre in units of h.
        w: by channel ∫ L_0 w dw dx, w the direction to the light, and likewise w_x², w_y², w_x w_y, w_x w_z, w_y w_z;
            None where directions do not count.
        forward: whether rays go on through forward events.
    """

    scene: mi.Scene
    media: WalkMedia
    index: CellIndex
    tables: dict[str, Any]
    D: mi.Float
    w: mi.Float | None
    forward: bool

    def trace(self, k: int, rays: int, seed: int) -> None:
        """Add the light of so many rays that enter object k, or a few more."""
        parts = math.ceil(rays / AT_ONCE)
        for part in range(parts):
            checkpoint()
            # paths of scattered light have the seeds that end in 1 and 2
            start = self.enter(k, math.ceil(rays / parts), parts, (seed, k, part, 3))
            dr.while_loop((start,), lambda ray: ray.alive, lambda ray: (self.segment(ray),), label="rays of light")
            dr.eval(self.D, self.w)

    def enter(self, number: int, rays: int, parts: int, seed: tuple[int, ...]) -> _Ray:
        """Rays of emitters at points of the surface of an object, refracted into it: one of so many parts of them."""
        media, rng, k = self.media, generator(mi, rays, pass_seed(*seed)), dr.opaque(mi.Int32, number, rays)
        si, flux = lit_points(self.scene, media, number, rays, seed, rng)
        bs, value = sample_bsdf(media.boundary(k), si, rng, _only(mi.BSDFFlags.Transmission))
        d, _ = sided(si, bs.wo)
        enters = (bs.pdf > 0) & (dr.dot(d, si.n) < 0) & ~media.enclosed(k)
        flux = dr.select(enters, flux * value * (bend(si, bs.wo, d) / opaque(parts)), 0)
        enters &= dr.max(flux) > 0
        T = dr.full(mi.Spectrum, 1, rays)
        channel = dr.minimum(mi.UInt32(rng.next_float32() * len(T)), len(T) - 1)
        return _Ray(
            object=k, o=mi.Point3f(si.p), d=d, off=media.clear(k, si.n, d), flux=mi.Spectrum(flux), T=T,
            entered=dr.max(flux), channel=channel, density=mi.Spectrum(T), alive=mi.Bool(enters), rng=rng,
            within=media.inner.priorities.start(mi.UInt32(k)) if media.overlaps else (),
        )  # fmt: skip

    def segment(self, ray: _Ray) -> _Ray:
        """Light along a ray as far as the surface, and its reflection there."""
        # ---- find the end of the segment
        media, d = self.media, ray.d
        scene = (media.inner or media).scene
        si = media.instance_scene.intersect(scene, mi.Ray3f(ray.o + ray.off, d), mi.RayFlags.All, active=ray.alive)
        alive = ray.alive & si.is_valid()
        far = dr.select(alive, dr.maximum(si.t + dr.dot(ray.off, d), 0), 0)

        # ---- light along it
        self._add(ray, far, alive)
        if self.forward:
            return self._fly(ray, si, far, alive)
        return self._reflect(ray, si, alive, ray.T * self._transmittance(ray, far))

    def _reflect(self, ray: _Ray, si: mi.SurfaceInteraction3f, alive: mi.Bool, T: mi.Spectrum) -> _Ray:
        """Reflection at the surface, where the ray arrives with the transmittance T."""
        media, d, rng = self.media, ray.d, ray.rng

        # ---- what is met: behind boundaries that a higher priority hides the ray goes on, and behind its own if
        # rounding has put it outside; a shape in the object ends it
        k, found, within = ray.object, media.met(si, ray.object), ray.within
        met = found == k
        boundary = media.boundary(k)
        ends = mi.Bool(False) if media.inner is None else media.inner.around(si) == k
        si = media.seen(si, found if media.overlaps or media.nested else k, d)
        own = met & (dr.dot(si.n, d) > 0)
        if media.overlaps:
            of = media.inner.priorities.meet(si, d, within)
            own, ends = own & ~of.passes, dr.select(of.member, ~of.passes & ~met, ends)
            boundary = dr.select(of.member & ~of.passes, of.bsdf, boundary)
            within = dr.select(of.member & of.passes, of.within, within)

        # ---- reflection: flux F, with roulette
        bs, value = sample_bsdf(boundary, si, rng, _only(mi.BSDFFlags.Reflection))
        new, _ = sided(si, bs.wo)
        left = dr.max(dr.abs(ray.flux * value * T)) / dr.maximum(ray.entered, 1e-30)
        survive = dr.minimum(left / ROULETTE, 1)
        reflected = (dr.dot(si.n, new) < 0) & (rng.next_float32() < survive)
        d = mi.Vector3f(dr.select(own, new, d))
        flux = dr.select(own, ray.flux * value / dr.maximum(survive, 1e-20), ray.flux)
        at_boundary = replace(
            ray, o=mi.Point3f(si.p), d=d, off=media.clear(k, si.n, d), flux=flux, T=T,
            alive=alive & ~ends & (~own | reflected), within=within,
        )  # fmt: skip
        return _either(*self._between(ray, si, found, T), at_boundary) if media.nested else at_boundary

    def _between(self, ray: _Ray, si: mi.SurfaceInteraction3f, found: mi.Int32, T: mi.Spectrum) -> tuple[mi.Bool, _Ray]:
        """Whether a ray meets a boundary between an object and one in it, and the ray reflected or refracted there."""
        # ---- into the object found, or out of it
        media, k, d = self.media, ray.object, ray.d
        around, inwards = media.inner.around(si), dr.dot(si.n, d) < 0
        into, out = (found != k) & (around == k) & inwards, (found == k) & (around >= 0) & ~inwards
        meets = (found >= 0) & (into | out)

        # ---- flux *= f cos / p, and what light has beyond the camera's paths
        ctx = mi.BSDFContext(mi.TransportMode.Importance)
        bs, value = sample_bsdf(media.boundary_pointer(dr.maximum(found, 0)), si, ray.rng, ctx)
        new, _ = sided(si, bs.wo)
        through = dr.dot(new, si.n) * dr.dot(d, si.n) > 0
        flux = ray.flux * value * dr.select(through, adjoint(si, d, new), 1)

        # ---- the way on, with roulette
        left = dr.max(dr.abs(flux * T)) / dr.maximum(ray.entered, 1e-30)
        survive = dr.minimum(left / ROULETTE, MOST_SURVIVAL)
        alive = ray.alive & si.is_valid() & (bs.pdf > 0) & (ray.rng.next_float32() < survive)
        to = dr.select(through, dr.select(into, found, around), k)
        o, off = media.depart(si, new, mi.Bool(True))
        flux /= dr.maximum(survive, 1e-20)
        return meets, replace(ray, object=to, o=o, d=new, off=off, flux=flux, T=T, alive=alive)

    def _fly(self, ray: _Ray, si: mi.SurfaceInteraction3f, far: mi.Float, alive: mi.Bool) -> _Ray:
        """A flight to a forward event, or to the surface and its reflection there."""
        media, rng = self.media, ray.rng

        # ---- flux T / p at the surface, flux sigma_s T / p at an event, p the mean over channels
        m = media.coefficients(ray.object, ray.o)
        t = free_path(m, ray.channel, rng.next_float32())
        if media.varies:
            t, flux, density, scatters, rng = self._collide(ray, t, far, alive)
        else:
            flight = fly(m, ray.flux, ray.density, ray.channel, t, far)
            flux, density, scatters = flight.weight, flight.density, flight.scatters
        ray = replace(ray, flux=flux, density=density)
        at_surface = self._reflect(ray, si, alive & ~scatters, ray.T)

        # ---- a turn by the phase function, of which 1 - q is forward
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        d, flux, density = turn(m, ray.flux, ray.density, ray.channel, ray.d, u, media.same_g)
        flux *= kept_forward(dr.dot(ray.d, d), m.g)

        # ---- roulette
        survive = dr.minimum(dr.max(dr.abs(flux)) / dr.maximum(ray.entered * ROULETTE, 1e-30), 1)
        alive = alive & scatters & (rng.next_float32() < survive)
        at_event = replace(
            ray, o=mi.Point3f(ray.o + ray.d * t), d=d, off=media.behind(ray.object, d),
            flux=flux / dr.maximum(survive, 1e-20), density=density, alive=alive,
        )  # fmt: skip
        return _either(scatters, at_event, at_surface)

    def _collide(self, ray: _Ray, t: mi.Float, far: mi.Float, alive: mi.Bool) -> tuple:
        """The distance of the first collision that is not null, where a medium varies, the flux and density there or at
        the surface, whether it is before that, and the random numbers. `t`: of the first collision."""
        channel = ray.channel

        def fly_on(
            start: mi.Float, t: mi.Float, flux: mi.Spectrum, density: mi.Spectrum, scatters: mi.Bool, going: mi.Bool,
            rng: mi.PCG32,
        ) -> tuple:  # fmt: skip
            # the flight from the last collision at `start`
            m = self.media.coefficients(ray.object, ray.o + ray.d * t)
            flight = fly(m, flux, density, channel, t - start, far - start, rng.next_float32())
            later = t + free_path(m, channel, rng.next_float32())
            return t, dr.select(flight.null, later, t), flight.weight, flight.density, flight.scatters, flight.null, rng

        state = mi.Float(0), t, ray.flux, ray.density, mi.Bool(False), alive, ray.rng
        _, t, flux, density, scatters, _, rng = dr.while_loop(state, lambda *s: s[5], fly_on, label="collisions")
        return t, flux, density, scatters, rng

    def _add(self, ray: _Ray, far: mi.Float, active: mi.Bool) -> None:
        """Add light to the cells at points of a segment, drawn by mean_c sigma_c T_c / (1 - T_c(far))."""
        n, points = len(mi.Spectrum(0)), FORWARD_ALONG if self.forward else ALONG
        sigma_t = self.media.spectrum("sigma_t", ray.object)
        if self.forward and self.media.nested:
            even = dr.max(dr.abs(self.media.spectrum("g", ray.object))) == 0
            points = dr.select(even, mi.UInt32(ALONG), points)
        at = dr.gather(dict, self.tables, self.media.place_of(ray.object))
        ends = 1 - dr.exp(-sigma_t * far)
        a, b, c_ = -ray.d
        angles = mi.Vector4f(a, b, c_, a * a), mi.Vector4f(b * b, a * b, a * c_, b * c_)
        u_0, first = ray.rng.next_float32(), mi.UInt32(ray.rng.next_float32() * n)

        def add(j: mi.UInt32, rng: mi.PCG32) -> tuple[mi.UInt32, mi.PCG32]:
            # ---- a point at the distance s
            rate, end = (pick(v, (first + j) % n) for v in (sigma_t, ends))
            u = u_0 + mi.Float(j) / points
            s = dr.minimum(-dr.log(1 - dr.minimum((u - dr.floor(u)) * end, 1 - 2**-24)) / rate, far)
            pdf = dr.sum(sigma_t * dr.exp(-sigma_t * s) / dr.maximum(ends, 1e-20)) / n
            light = ray.flux * ray.T * self._transmittance(ray, s, rng) / dr.maximum(pdf * points, 1e-20)

            # ---- its cell, and its place there
            x = mi.Point3f((ray.o + ray.d * s - at["low"]) * at["scale"])
            slot, y, _, held = self.index.find(x, at["first"], at["counts"], active & (far > 0))

            # ---- light x_j by channel, and light by directions
            for c in range(n):
                index = mi.UInt32(slot * n + c)
                dr.scatter_add(self.D, mi.Vector4f(1, y.x, y.y, y.z) * light[c], index, held)
                for i, part in enumerate(angles if self.w is not None else ()):
                    dr.scatter_add(self.w, part * light[c], index * 2 + i, held)
            return j + 1, rng

        dr.while_loop((mi.UInt32(0), mi.PCG32(ray.rng)), lambda j, rng: j < points, add, label="points of a ray")

    def _transmittance(self, ray: _Ray, s: mi.Float, rng: mi.PCG32 | None = None) -> mi.Spectrum:
        """exp(-∫ sigma_t) over a distance along a ray."""
        return self.media.transmittance(ray.object, mi.Ray3f(ray.o, ray.d), s, rng or ray.rng)


def _only(flags: int) -> mi.BSDFContext:
    """The part of a boundary that transmits or reflects, for light."""
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    ctx.type_mask = flags
    return ctx


def _either(first: mi.Bool, a: _Ray, b: _Ray) -> _Ray:
    """One of two rays, which have the random numbers of the second."""
    state = {key: dr.select(first, value, getattr(b, key)) for key, value in vars(a).items() if key != "rng"}
    return _Ray(**state, rng=b.rng)
