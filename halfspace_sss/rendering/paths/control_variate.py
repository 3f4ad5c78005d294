"""Light that enters the cells of an object, gathered for an image: a control variate of sampled entries.

See `gathered.patches`. Phi is an unbiased estimate by points uniform over the object, each with an emitter sample and a
direction by the cosine. It is drawn anew for each image, by its seed. Its noise is shared by neighbouring pixels; it
falls as theirs does, by `PER_SAMPLE` points that an exit sees for each sample of a pixel. Where these take too large a
share of all samples, as on small images of opaque media, there is no control variate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.gathered.patches import PatchTransfer, TransferRow, patch_transfer
from halfspace_sss.rendering.gathered.points import uniform_entries
from halfspace_sss.rendering.object.points import SurfacePoint, opaque
from halfspace_sss.rendering.object.shape import same_objects
from halfspace_sss.rendering.paths.gathering import (
    TRACED,
    GatheringPoint,
    by_cosine,
    by_emitters,
    light_state,
    spreads,
)
from halfspace_sss.rendering.paths.lighting import Primal, RenderContext

if TYPE_CHECKING:
    from halfspace_sss.rendering.object.objects import TranslucentObject
    from halfspace_sss.rendering.object.settings import Settings

FEWEST = 2**14  # points of an object at which light is gathered,
PER_SAMPLE = 32  # of those that an exit sees, over the samples of a pixel: less noise than these leave,
MOST_SHARE = 1 / 16  # of all samples,
FIXED = 2**31 - 1  # a seed
LEAST_PAYING = 0.1  # of the points that are wanted: with fewer there is no control variate


@dataclass(frozen=True, eq=False)
class ControlVariate:
    """Of one object.

    Args:
        transfer: T.
        factor: of T, per channel.
        known: Σ_k T_jk Phi_k of all cells j, channel by channel.
    """

    transfer: PatchTransfer
    factor: mi.Spectrum
    known: mi.Float

    def row(self, out: SurfacePoint, face: mi.UInt32, active: mi.Bool) -> TransferRow:
        """The cell of an exit on a face, and a(w_o) times the factor."""
        j, a = self.transfer.row(out, face, active)
        return TransferRow(j, a * self.factor)

    def radiance(self, out: SurfacePoint, face: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """a(w_o) Σ_k T_jk Phi_k of an exit on a face."""
        row = self.row(out, face, active)
        return row.a * dr.gather(mi.Spectrum, self.known, row.j, active)


class ControlVariates:
    """Those of the objects of a scene; transfers are kept until the objects change."""

    def __init__(self) -> None:
        self._objects: list[TranslucentObject] = []
        self._transfers: list[PatchTransfer | None] = []
        self._light: tuple[list, list] = ([], [])
        self._factors: dict[int, np.ndarray] = {}  # of the light that they are for

    def of(
        self, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, seed: int, spp: int, pixels: int
    ) -> list[TranslucentObject]:
        """The objects, each with its control variate where it can have one that pays.

        Args:
            scene, objects, settings: what is rendered.
            seed: of the points at which light is gathered.
            spp, pixels: samples of a pixel, and pixels.
        """
        if not same_objects(objects, self._objects):
            self._transfers = [patch_transfer(obj) if _applies(obj) else None for obj in objects]
            self._objects, self._light = objects, ([], [])
        state = light_state(scene)
        if state[0] != self._light[0]:
            self._light, self._factors = state, {}
        context, results = RenderContext.of(scene, objects, settings, Primal()), []
        for k, (obj, T) in enumerate(zip(objects, self._transfers)):
            wanted = 0 if T is None else max(int(PER_SAMPLE * spp / T.seen), FEWEST)
            count = int(min(wanted, MOST_SHARE * spp * pixels))
            if T is None or count <= LEAST_PAYING * wanted:
                results.append(obj)
                continue
            if k not in self._factors:  # by light of its own: a factor must not follow Phi
                self._factors[k] = T.factor(_arriving(context, obj, T, FIXED, FEWEST)[1])
            results.append(replace(obj, control=_control(context, obj, T, self._factors[k], seed, count)))
        return results


def _applies(obj: TranslucentObject) -> bool:
    """Whether an object has one surface of known area whose entries are sampled everywhere."""
    result = obj.geometry
    even = obj.surface.inside.is_homogeneous and obj.wrapping.bend is None
    return spreads(obj) and result.closed and result.area > 0 and result.pieces is None and even


def _control(
    context: RenderContext, obj: TranslucentObject, T: PatchTransfer, factor: np.ndarray, seed: int, count: int
) -> ControlVariate:
    Phi = _arriving(context, obj, T, seed, count)[0].astype(np.float32)
    known = np.stack([T.T[:, :, c] @ row for c, row in enumerate(Phi)], axis=1)
    return ControlVariate(T, dr.opaque(mi.Spectrum, factor.tolist()), mi.Float(known.ravel()))


def _arriving(
    context: RenderContext, obj: TranslucentObject, T: PatchTransfer, seed: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Phi, (channels, cells), and the relative variance of light in a cell, per channel."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(int(np.random.SeedSequence([seed, 28]).generate_state(1)[0]), count)
    entry = uniform_entries(obj.geometry, sampler.next_1d(), sampler.next_2d())
    k, known = T.cells(entry.p, entry.n, entry.face, mi.Bool(True))
    at = GatheringPoint(entry.p, entry.n, entry.n_out)
    aimed, _ = by_emitters(context.scene, T.albedo, at, sampler.next_2d())
    # beside each other, as lanes that wait cost as much
    traced = dr.arange(mi.UInt32, count) < dr.opaque(mi.UInt32, count // TRACED)
    met, more, a, *_ = by_cosine(
        context.scene, context.objects, T.albedo, context.settings, at, sampler.next_2d(), traced, sampler
    )
    light = aimed + met + opaque(count / (count // TRACED)) * more
    if context.uses_sky(obj):
        light -= a * context.sky_means(obj)[1]
    light = mi.Spectrum(light)
    dr.eval(light, k, known)
    k, known, rows = np.array(k), np.array(known), np.array(light, dtype=float)
    k, rows, cells, Phi, v = k[known], rows[:, known], len(T.cells.points), [], []
    points = np.maximum(np.bincount(k, minlength=cells), 1)
    for row, whole in zip(rows, T.albedo.whole):
        total = np.bincount(k, row, cells)
        Phi.append(total * (obj.geometry.area / count / whole))
        v.append(max((row**2).sum() / max((total**2 / points).sum(), 1e-30) - 1, 0))
    return np.stack(Phi), np.array(v)
