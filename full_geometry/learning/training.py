"""Learning S of one object: walks of random exits and of the camera, steps in turn, with the error as it falls."""

from __future__ import annotations

import io
import json
import math
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.points import SurfacePoint, evaluate
from full_geometry.learning.model_errors import (
    ExitRadiance,
    ExitTruth,
    RadianceError,
    compare,
    modelled,
    reference,
    traced,
)
from full_geometry.learning.network_fitting import PROPOSED, STANDARD, ObjectFit, Recipe
from full_geometry.objects.objects import TranslucentObject, object_of
from full_geometry.scenes.camera_walks import TRIAL, CameraWalks
from full_geometry.transport import storing
from full_geometry.transport.exit_pairs import EntryProposals, Pairs, PairSource, WalkExits, shuffled
from full_geometry.transport.features import n_local, n_pair, n_side
from full_geometry.transport.one_object import BASE_MODEL, FullGeometry, HalfSpace
from full_geometry.transport.patches import Patches, PatchSampler, cluster
from full_geometry.transport.storing import Identity, frame_of, identify
from halfspace_sss.arrays import aligned
from halfspace_sss.backend import clock
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.store import check_weights_folder, to_json
from halfspace_sss.neural.training.fit import CHECKPOINT, claim
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder, provenance, write_atomically

# ---- Where the learnt directional albedo is good enough for images ----------------------------
# S sees the surface around both its points, alpha is a network of the exit alone, which misses what changes over a mean
# free path. So each channel is judged at the end of a training, as parts of all light that leaves,
#
#     |alpha_1 - E T_1|, |alpha - E T| <= 5 % of the mean of E T_0 + E T_1 + E T,   or alpha no worse than S,
#
# and where that fails images take uniform light by S or by the way of one event, as all other light.

MOST = 0.05


def trusted(
    model: FullGeometry, truth: ExitTruth, errors: list[RadianceError], walks: int, seed: tuple[int, ...]
) -> np.ndarray:
    """1 where the directional albedo may be used and 0 where not, (2, channels): orders below two, then the others.
    `model`: S and alpha. `truth`: exits and walks of orders from two on. `errors`: of S there. `walks`: of each exit,
    for order one."""
    once = traced(model.object, truth.exits, walks, seed, fewest=1, most=1)
    parts = model.alpha.parts(truth.exits)
    dr.eval(parts)
    unscattered, *alphas = (np.array(part).reshape(len(once.mean), -1) for part in parts)
    known = (once, truth.truth)
    means = [part.mean[:, :, 0].mean(axis=1) for part in known]
    light = np.maximum(unscattered.mean(axis=1) + sum(means), 1e-30)
    wrong = np.stack([_error(a, b) * mean / light for a, b, mean in zip(alphas, known, means)])
    by_S = np.array([row.error for row in errors if row.light == "constant"]) * means[1] / light
    return (wrong <= np.stack([0 * by_S + MOST, np.maximum(by_S, MOST)])).astype(np.float16)


def _error(alpha: np.ndarray, truth: ExitRadiance) -> np.ndarray:
    """Relative RMSE of shares (channels, exits) under constant light, without the noise of walks."""
    shares = alpha[:, :, None].astype(float)
    return np.array([row.error for row in compare(ExitRadiance(shares, np.zeros_like(shares)), truth, ["constant"])])


# ---- Exits that the camera sees, beside random ones: its walks are data for the fit as they come ---
# The likelihood holds for any distribution of exits, as long as proposals begin at the same ones: where walks begin in
# shares of two kinds, proposals do so too. Random exits stay half of them or more, so that all of an object is learnt.

SHARE = 0.5  # of the walks of a chunk, at most, that the camera begins
PASSES = 4  # of a chunk
MOST_RAYS = 4  # times that share: where an object is small in the picture, its paths would take all of the time


class CameraSchedule(NamedTuple):
    """Samples per pixel of a pass, passes of a chunk that has them, and of how many chunks one has."""

    spp: int
    passes: int
    every: int

    def numbers(self, k: int) -> list[int]:
        return [] if k % self.every else [k // self.every * self.passes + j for j in range(self.passes)]

    @classmethod
    def of(cls, walks: float, hits: int, pixels: int) -> CameraSchedule | None:
        """Plan so many walks of a chunk, where `hits` of `pixels` paths meet the object; None if none do."""
        if hits == 0:
            return None
        spp = min(SHARE * walks / hits, MOST_RAYS * SHARE * walks / pixels)
        if spp >= PASSES:  # more than one, whose spread is the variance of their image
            return cls(int(spp / PASSES), PASSES, 1)
        return cls(1, 1, math.ceil(1 / spp))


class CameraExits:
    """The part of each chunk that comes from the camera.
    `source`: of the pairs. `walks`: of a chunk, those of the camera included."""

    def __init__(self, source: PairSource, camera: CameraWalks, walks: int, seed: int) -> None:
        self.source, self.camera, self.walks, self.seed = source, camera, walks, seed
        self.shape = source.object.geometry.shape
        self.schedule = CameraSchedule.of(walks, camera.hits(self.shape), camera.pixels)

    def seconds_more(self) -> float:
        """Seconds of a chunk in the mean, by the second one; compiles what passes need."""
        if self.schedule is None or self.schedule.every == 1:
            return 0.0
        for _ in range(2):
            started = time.monotonic()
            self.camera.exits(self.shape, TRIAL, self.schedule.spp)
        return (time.monotonic() - started) * self.schedule.passes / self.schedule.every

    def data(self, k: int, proposed: int) -> tuple[Pairs, Pairs]:
        """Walks and proposals of chunk k."""
        seed, order = (self.seed, k), np.random.default_rng([self.seed, k, 1])
        parts = []
        if self.schedule:
            parts = self._exits(self.schedule.numbers(k), order)
        walks, proposals = [], []
        for j, (starts, ends) in enumerate(parts):
            n = dr.width(starts.p)
            m = round(proposed * n / self.walks)
            at = starts.gather(aligned(mi.UInt32, order.integers(0, n, m)))
            walks.append(self.source.ended(starts, ends, (*seed, 5, j)))
            proposals.append(self.source.proposed(m, (*seed, 3, j), at))
        wanted = (self.walks, walks), (proposed, proposals)
        left = [total - sum(part.drawn for part in done) for total, done in wanted]
        walks.append(self.source.walks(left[0], seed))
        proposals.append(self.source.proposed(left[1], seed))
        return (shuffled(walks, order), shuffled(proposals, order)) if parts else (walks[0], proposals[0])

    def _exits(self, numbers: list[int], order: np.random.Generator) -> list[tuple[SurfacePoint, WalkExits]]:
        """Starts and ends of walks from the camera, launch by launch; of too many a random choice."""
        launches = [part for number in numbers for part in self.camera.exits(self.shape, number, self.schedule.spp)]
        with_exits = [part for part in launches if dr.width(part.object)]
        ends = np.cumsum([0, *(dr.width(part.object) for part in with_exits)])
        chosen = np.sort(order.permutation(int(ends[-1]))[: int(SHARE * self.walks)])
        parts = []
        for part, a, b in zip(with_exits, ends, ends[1:]):
            own = chosen[(chosen >= a) & (chosen < b)] - a
            if len(own):
                _, starts, ends = part.gather(aligned(mi.UInt32, own))
                ends = ends._replace(T=dr.select(ends.order >= 1, ends.T, 0))  # of the orders from one on
                parts.append((self.source.object.knowing(starts), ends))
        evaluate(parts)
        return parts


VALIDATIONS = 4  # in a run
EXITS, WALKS, SAMPLES = 256, 2048, 512  # of a validation
CHECKPOINT_EVERY = 15.0  # seconds
PLAN, PLACES = "plan.json", "places.npz"
LOOP_SHARE = 0.83  # of the seconds for data and steps, the rest for pilot, solving and errors


@dataclass(frozen=True, eq=False)
class Trained:
    """The result of a training.

    Args:
        model: ready to be asked.
        sampler: of its entries; None for a shape without faces.
        path: file of its weights; None after 0 seconds.
        errors: per channel and light, at the end.
        steps, seconds: of the fit; that it took in this process.
    """

    model: FullGeometry
    sampler: PatchSampler | None
    path: Path | None
    errors: list[RadianceError]
    steps: int
    seconds: float


@dataclass(frozen=True)
class TrainingPlan:
    """How long, how large and from where a training goes.

    Args:
        seconds: for data, fit and validation, after the kernels are compiled; 0 gives the half-space, with a warning.
        target_error: stop once the largest error under constant light has come down to it.
        recipe: sizes and rates.
        chunks: number of chunks instead of a plan by time.
        refine: begin from the weights of the same shape with the medium that is most alike, see `storing.nearest`.
    """

    seconds: float = 60.0
    target_error: float | None = None
    seed: int = 0
    recipe: Recipe = STANDARD
    chunks: int | None = None
    refine: bool = False

    def __post_init__(self) -> None:
        check_interval("seconds", self.seconds, 0.0, 1e7)
        check_count("seed", self.seed, 0)
        if self.target_error is not None:
            check_interval("target_error", self.target_error, 1e-4, 1.0)
        if self.chunks is not None:
            check_count("chunks", self.chunks, 1)


def train(
    shape: mi.Shape | mi.Scene | TranslucentObject,
    medium: Medium | None = None,
    *,
    mm_per_unit: float | None = None,
    object: str | None = None,
    folder: str | Path | None = None,
    work: str | Path | None = None,
    camera: CameraWalks | None = None,
    progress: NamedProgress | None = None,
    **plan: Any,
) -> Trained:
    """Learn S of an object and write its weights.

    The number of chunks is planned once, by the time of the first one, so that a run that was killed and goes on with
    the same `work` ends with the same weights. The data of a chunk are made beside the steps on the one before it.

    Args:
        shape: a closed Mitsuba shape, a scene, or a `TranslucentObject`, which has its medium.
        medium: 1/mm, scalar or one value per channel; of a scene it is that of the object's `translucent` surface.
        mm_per_unit: length of a scene unit, mm; by default what the integrator of a scene says, and 1 for a shape.
        object: id of the object in a scene; may be left out where there is one.
        folder: for the weights; by default HALFSPACE_SSS_WEIGHTS or the user's data folder.
        work: folder for unfinished work.
        camera: walks from the camera, which join those of random exits.
        progress: called with (what, done, total).
        plan: fields of `TrainingPlan`.

    Raises:
        ValueError: an argument is out of range, there are no weights to refine, or `work` is of another run; nothing
            has been traced then.
    """
    obj = shape if isinstance(shape, TranslucentObject) else object_of(shape, medium, mm_per_unit, object)
    how = TrainingPlan(**plan)
    folder = check_weights_folder(folder)
    if work is not None:
        check_folder(work)
    if not any(float(m.sigma_s) > 0 for m in obj.media):
        raise ValueError("medium must scatter in at least one channel to be learnt, got sigma_s 0 in all")
    start = storing.nearest(obj, asdict(how.recipe), folder) if how.refine else None
    if how.refine and start is None:
        raise ValueError(f"refine must have weights of the same shape and a medium alike in {folder}, got none")
    recipe = how.recipe if start is None else how.recipe.refining()
    run = _ObjectTraining(obj, recipe, int(how.seed), Path(work) if work else None, camera, start)
    if how.seconds == 0:
        warnings.warn(f"an object that is trained for 0 seconds is rendered by {BASE_MODEL}", stacklevel=2)
        return Trained(*run.learnt(), None, [], 0, 0.0)
    return run.go(how.seconds, how.chunks, how.target_error, folder, progress)


def train_unattended(
    obj: TranslucentObject,
    folder: str | Path,
    *,
    cpu_seconds: float = 0.0,
    chunks: int | None = None,
    seed: int = 0,
    recipe: Recipe = STANDARD,
) -> Trained:
    """Learn an object without errors on the way, in seconds of CPU time whatever else the machine does, or by chunks.
    `cpu_seconds`: of this process, for data and fit; errors at the end take more. `chunks`: instead, each of
    `recipe.chunk` walks that are kept, so that the clock has no part in the weights. `seed`, `recipe`: of everything;
    sizes and rates."""
    if chunks is None:
        check_interval("cpu_seconds", cpu_seconds, 1e-3, 1e7)
    else:
        check_count("chunks", chunks, 1)
    return _ObjectTraining(obj, recipe, seed, None, None).unattended(folder, cpu_seconds, chunks)


def _claim_places(work: Path, identity: Identity) -> None:
    """Write where the points of an object and of what lies in it are, or check that it has only been moved since.
    ValueError if it is another one."""
    path = work / PLACES
    if not path.exists():
        file = io.BytesIO()
        np.savez(file, anchors=identity.anchors, probes=identity.probes)
        write_atomically(path, file.getvalue())
        return
    with np.load(path, allow_pickle=False) as before:
        known = replace(identity, anchors=before["anchors"], probes=before["probes"])
    try:
        known.pose(identity)
    except ValueError as error:
        raise ValueError(f"{work}: work must come from the same object, name another folder: {error}") from error


class _ObjectTraining:
    def __init__(
        self,
        obj: TranslucentObject,
        recipe: Recipe,
        seed: int,
        work: Path | None,
        camera: CameraWalks | None,
        start: storing.Neighbour | None = None,
    ) -> None:
        self.start = start
        self.object, self.recipe, self.seed, self.work, self.camera = obj, recipe, seed, work, camera
        self.identity, self.frame = identify(obj), frame_of(obj)
        self.base = HalfSpace(obj, BASE_MODEL)
        self.proposals = EntryProposals(obj, self.base)
        self.source = PairSource(obj, self.frame, self.base, self.proposals)
        self.seen: CameraExits | None = None
        self.patches = self.centres = None
        if mesh.has_faces(obj.geometry.shape):
            known = start.arrays[storing.CENTRES] if start else cluster(obj, self.frame, seed=seed)
            self.centres = known.astype(np.float16)
            self.patches = Patches(obj, self.frame, self.centres.astype(np.float32))
        self.fitting = self._new_fitting()
        self.trusted = np.ones((2, len(obj.media)), np.float16)
        self.done, self.total, self.walks, self.history = 0, math.inf, recipe.chunk, []
        self.ready: tuple[Pairs, Pairs] | None = None
        self.aside = ThreadPoolExecutor(1)

    def _new_fitting(self) -> ObjectFit:
        channels = len(self.object.media)
        n_in = 2 * n_side(channels, n_local(self.object)) + n_pair(channels)
        return ObjectFit(n_in, channels, self.object.media[0].eta, self.recipe, self.seed, self.patches)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays to be written: in half precision, but for what turns the inputs."""
        arrays = {name: value.astype(np.float16) for name, value in self.fitting.arrays().items()}
        arrays |= {storing.TRUSTED: self.trusted, storing.TURNS: self.frame.around.turns}
        return arrays if self.centres is None else {**arrays, storing.CENTRES: self.centres}

    def learnt(self) -> storing.Learnt:
        """Model and sampler as they stand."""
        return storing.assemble(self.object, self.frame, self.base, self.arrays(), self.patches)

    def go(
        self, seconds: float, chunks: int | None, target: float | None, folder: Path, progress: NamedProgress | None
    ) -> Trained:
        started, began = time.monotonic(), clock()
        self._prepare(chunks)
        truth = reference(self.object, EXITS, WALKS, self.seed)
        saved, what = time.monotonic(), "training"
        while self.done < self.total and not self._reached(target):
            self._chunk(seconds)
            validates = self.done in {round(self.total * (k + 1) / VALIDATIONS) for k in range(VALIDATIONS - 1)}
            if validates:
                self.history.append(self._validated(truth))
                what = f"training (error {self.history[-1][1]:.3f} ± {self.history[-1][2]:.3f})"
            if self.work and (time.monotonic() - saved > CHECKPOINT_EVERY or validates):
                self._save_camera()  # first: what its image holds beyond the checkpoint is not added again
                self.fitting.save(self.work / CHECKPOINT, self.done, self.history)
                saved = time.monotonic()
            if progress:
                progress(what, self.done, self.total)
        self.fitting.solve(self.source, self.done, self.seed)
        errors = self._judged(truth, 2 * WALKS)
        self._save_camera()
        return self._written(folder, errors, clock() - began, started)  # of all cores, as the trade counts

    def unattended(self, folder: str | Path, seconds: float, chunks: int | None) -> Trained:
        """Without errors on the way: for CPU seconds, or a number of chunks in place of a plan by them."""
        started, began = time.monotonic(), clock()
        self._prepare(chunks)
        while self.done < self.total:
            self._chunk(seconds, time.process_time)
        self.fitting.solve(self.source, self.done, self.seed)
        spent = clock() - began
        errors = self._judged(reference(self.object, EXITS, WALKS, self.seed), SAMPLES)
        return self._written(folder, errors, spent, started)

    def _written(self, folder: str | Path, errors: list[RadianceError], spent: float, started: float) -> Trained:
        """The result, with its weights in a file, whose record says how many seconds were spent on the fit."""
        path = storing.save(folder, self.identity, self.arrays(), self._record(errors, spent))
        return Trained(*self.learnt(), path, errors, self.fitting.step, time.monotonic() - started)

    def _prepare(self, chunks: int | None = None) -> None:
        """Scales and shares from a pilot, which compiles all kernels; the work of a run that was killed."""
        seed, n = (self.seed, 2**31), self.recipe.chunk // 4
        traced = self.source.traced(n, seed)
        self.fitting.set_scale(self.source.ended(*traced, seed))
        if self.start:
            self.fitting.start(self.start.arrays, self.source.ended(*traced, seed))
        self.source = self.source.scaled(self.fitting.scale.cpu().numpy()[:, 0])
        pilot, proposed = self.source.ended(*traced, seed), self.source.proposed(n, seed)
        self.walks = int(self.recipe.chunk / min(max(pilot.values.shape[1] / pilot.drawn, 0.05), 1.0))
        self._new_fitting().use(pilot, proposed, None, np.random.default_rng(0))
        run = {"object": self.identity.record(), "recipe": asdict(self.recipe), "seed": self.seed}
        run |= {"start": self.start.path.name} if self.start else {}
        if self.camera:
            self.seen = CameraExits(self.source, self.camera, self.walks, self.seed)
            run["camera"] = {"scene": self.camera.about.get("scene"), "schedule": self.seen.schedule}
        if self.work:
            claim(self.work, **run)
            _claim_places(self.work, self.identity)
            if (self.work / PLAN).exists():
                chunks = int(json.loads((self.work / PLAN).read_text(encoding="utf-8"))["chunks"])
            if (self.work / CHECKPOINT).exists():
                self.done, self.history = self.fitting.load(self.work / CHECKPOINT)
        if chunks is not None:
            self._plan(chunks)

    def _plan(self, chunks: int) -> None:
        """Fix the number of chunks, and write it down for a run that goes on after this one."""
        self.total = chunks
        if self.work:
            write_atomically(self.work / PLAN, to_json({"chunks": chunks}))

    def _data(self, k: int) -> tuple[Pairs, Pairs]:
        if self.seen:
            return self.seen.data(k, PROPOSED * self.recipe.chunk)
        walks = self.source.walks(self.walks, (self.seed, k))
        return walks, self.source.proposed(PROPOSED * self.recipe.chunk, (self.seed, k))

    def _chunk(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Steps on a chunk, while the data of the next one are made."""
        walks, proposals = self.ready or self._data(self.done)
        at, following = clock(), None
        if self.done + 1 < self.total:
            following = self.aside.submit(self._data, self.done + 1)
        per_chunk = self.recipe.reuse * max(self.recipe.chunk // self.recipe.batch, 1)
        # the first chunk does not know of the plan, and neither does its rate
        steps = self.total * per_chunk if self.done or self.total == 1 else None
        self.fitting.use(walks, proposals, steps, np.random.default_rng([self.seed, self.done]))
        self.ready = following.result() if following else None
        self.done += 1
        if self.total == math.inf:
            each = clock() - at + (self.seen.seconds_more() if self.seen else 0.0)
            self._plan(max(int(LOOP_SHARE * seconds / each), 2))

    def _errors(self, truth: ExitTruth, samples: int) -> list[RadianceError]:
        """The errors of the model as it stands; entries follow the patches, which have less noise than probes."""
        model, sampler = self.learnt()
        by = self.proposals.with_patches(sampler)
        return compare(modelled(model, by, truth.exits, samples, self.seed), truth.truth)

    def _judged(self, truth: ExitTruth, samples: int) -> list[RadianceError]:
        """Errors at the end, and where the directional albedo may be used."""
        errors = self._errors(truth, samples)
        self.trusted = trusted(self.learnt().model, truth, errors, WALKS, (self.seed, 20))
        return errors

    def _validated(self, truth: ExitTruth) -> tuple[int, float, float]:
        """Chunk, largest error under constant light and its standard error."""
        rows = self._errors(truth, SAMPLES)
        live = [r for r in rows if r.light == "constant" and float(self.object.media[r.channel].sigma_s) > 0]
        worst = max(live, key=lambda r: r.error, default=rows[0])
        return self.done, worst.error, worst.standard_error

    def _reached(self, target: float | None) -> bool:
        return target is not None and bool(self.history) and self.history[-1][1] <= target

    def _save_camera(self) -> None:
        if self.camera:
            self.camera.save()

    def _record(self, errors: list[RadianceError], seconds: float) -> dict[str, Any]:
        return {
            "recipe": asdict(self.recipe), "seed": self.seed, "steps": self.fitting.step, "chunks": self.done,
            "walks": self.walks * self.done, "seconds": seconds, "history": self.history,
            "errors": [row._asdict() for row in errors], "provenance": provenance(seed=self.seed),
        }  # fmt: skip
