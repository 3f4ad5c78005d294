"""The paper's flow: coupling layers over a Gaussian in space, given an exit; its samples are laid onto the surface.

The target is read as t(x_i) = ∫ S(x_i, w_i; x_o, w_o) L_i mu_i dw_i (Eq. 12), of even light by a grid of 16 x 64
directions, of a scene's by emitter sampling. It is fitted at points uniform over the area: -E[t log p(x_i | x_o, w_o)].
S is that of a trained model of the object. A sample in space is taken to a random point of the nearest triangle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
import zuko

from benchmarks.fits import ADAM, CpuSchedule, Objective
from benchmarks.published.paper_network import placed
from full_geometry.geometry.mesh import face_vertices, vertex_positions
from full_geometry.geometry.points import SurfacePoint, channel_mean, cosine_above, place, surface_point
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import ObjectFrame
from full_geometry.transport.one_object import FullGeometry
from halfspace_sss.neural.training.fit import Descent, fit
from halfspace_sss.tracing.walk import generator, pass_seed

HIDDEN, LAYERS = (128, 128), 6
GRID = (16, 64)  # directions
DRAWS = 32  # of emitters
PAIRS, POINTS = 2**10, 4  # exits of a chunk, and points of each
BATCH, RATE, REUSE = 512, 1e-3, 8


@dataclass(frozen=True, eq=False)
class SpaceFlow:
    """The flow of an object.

    Args:
        flow: of zuko.
        frame: of the object.
    """

    flow: zuko.flows.Flow
    frame: ObjectFrame

    def sample(self, exits: SurfacePoint, n: int, seed: int = 0) -> np.ndarray:
        """n points in space of each of m exits, (m, n, 3), in the frame of the object over its radius."""
        told = torch.from_numpy(placed(self.frame, exits, dr.width(exits.p)))
        with torch.no_grad(), torch.random.fork_rng():
            torch.manual_seed(seed)
            return self.flow(told).sample((n,)).transpose(0, 1).numpy()


def incidence(model: FullGeometry, exits: SurfacePoint, points: SurfacePoint) -> np.ndarray:
    """t of pairs of exits and points, mean over channels: S mu over a grid of directions, uniform by the cosine.

    Args:
        model: of the object.
        exits: one for each point.
        points: of entry, with interpolated normals, see `TranslucentObject.random_places`.
    """
    n, (rows, columns) = dr.width(exits.p), GRID
    prepared = model.prepare(exits)

    def towards(k: mi.UInt32) -> mi.Float:
        u = mi.Point2f((mi.Float(k % rows) + 0.5) / rows, (mi.Float(k // rows) + 0.5) / columns)
        w, _ = cosine_above(points.n_out, points.n, u)
        return channel_mean(model.S(prepared, surface_point(points.p, points.n, points.n_out, w)))

    return _summed(towards, rows * columns, n) * np.pi / (rows * columns)


def lit_incidence(
    model: FullGeometry, exits: SurfacePoint, points: SurfacePoint, scene: mi.Scene, seed: tuple[int, ...]
) -> np.ndarray:
    """An unbiased estimate of t with the light of a scene, ∫ S L_i mu_i dw_i, by emitter sampling with shadows.

    Arguments as in `incidence`; light after reflection by other surfaces is left out.
    """
    prepared = model.prepare(exits)
    return _emitted(points, scene, seed, lambda at: channel_mean(model.S(prepared, at)))


def irradiance(points: SurfacePoint, scene: mi.Scene, seed: tuple[int, ...]) -> np.ndarray:
    """Light of emitters that arrives at points, mean over channels, ∫ L_i mu_i dw_i; as `lit_incidence` has it."""
    return _emitted(points, scene, seed, lambda at: mi.Float(1))


def _emitted(points: SurfacePoint, scene: mi.Scene, seed: tuple[int, ...], value: Callable) -> np.ndarray:
    n = dr.width(points.p)
    rng, it = generator(mi, n, pass_seed(*seed)), place(points.p, points.n)
    dr.eval(rng)

    def towards(k: mi.UInt32) -> mi.Float:
        # numbers of draw k begin where those of the draw before end
        own = mi.PCG32(rng)
        own += mi.Int64(2 * k)
        ds, L = scene.sample_emitter_direction(it, mi.Point2f(own.next_float32(), own.next_float32()))
        at = surface_point(points.p, points.n, points.n_out, ds.d)
        mu = dr.dot(ds.d, at.n_out)
        above = (dr.dot(ds.d, points.n) > 0) & (mu > 0) & (ds.pdf > 0)
        return dr.select(above, value(at) * channel_mean(mi.Color3f(L)) * mu, 0)

    return _summed(towards, DRAWS, n) / DRAWS


def _summed(towards: Callable[[mi.UInt32], mi.Float], count: int, n: int) -> np.ndarray:
    def add(k: mi.UInt32, total: mi.Float) -> tuple:
        return k + 1, total + towards(k)

    start = (mi.UInt32(0), dr.zeros(mi.Float, n))
    return np.array(dr.while_loop(start, lambda k, _: k < count, add)[1], dtype=float)


def fit_space_flow(
    model: FullGeometry, frame: ObjectFrame, seconds: float = 60.0, seed: int = 0, scene: mi.Scene | None = None
) -> SpaceFlow:
    """The flow after so many CPU seconds.

    Args:
        model: of the object.
        frame: of the object.
        seconds: of CPU time of this process, data included.
        seed: of everything.
        scene: whose light the flow knows, as in Eq. 12; None: light from everywhere.
    """
    schedule = CpuSchedule(seconds, rate=RATE)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        flow = zuko.flows.NICE(features=3, context=5, transforms=LAYERS, hidden_features=HIDDEN)

    def batches() -> Iterator[list[torch.Tensor]]:
        for chunk in count():
            pairs, order = _pairs(model, frame, (seed, 90, chunk), scene), np.random.default_rng([seed, 91, chunk])
            n = len(pairs[0])
            for rows in [r for _ in range(REUSE) for r in np.array_split(order.permutation(n), n // BATCH)]:
                yield [torch.from_numpy(values[rows]) for values in pairs]

    def loss(batch: list[torch.Tensor]) -> torch.Tensor:
        told, x, t = batch
        return -(t * flow(told).log_prob(x)).mean()

    learner, source = Objective(flow, loss), batches()
    fit(learner, lambda _: next(source), schedule, seed, descent=Descent(learner, betas=ADAM))
    return SpaceFlow(flow, frame)


def _pairs(
    model: FullGeometry, frame: ObjectFrame, seed: tuple[int, ...], scene: mi.Scene | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exits (n, 5), uniform points (n, 3) and t over its mean."""
    n = PAIRS * POINTS
    exits = model.object.random_points(generator(mi, PAIRS, pass_seed(*seed, 0)))
    exits = exits.gather(dr.arange(mi.UInt32, n) // POINTS)
    points = model.object.random_places(generator(mi, n, pass_seed(*seed, 1)))
    t = incidence(model, exits, points) if scene is None else lit_incidence(model, exits, points, scene, (*seed, 2))
    return placed(frame, exits, n), placed(frame, points, n)[:, :3], (t / t.mean()).astype(np.float32)


def mesh_arrays(obj: TranslucentObject, frame: ObjectFrame) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, in the frame over the radius, and faces, as libigl takes them."""
    vertices = vertex_positions(obj.geometry.shape).astype(np.float64)
    turn = np.eye(3) if frame.turn is None else np.array([np.array(row).ravel() for row in frame.turn])
    centre, radius = np.array(frame.centre, dtype=float).ravel(), float(np.array(frame.radius).item())
    faces = face_vertices(obj.geometry.shape).astype(np.int64)
    return np.ascontiguousarray((vertices - centre) @ turn.T / radius), faces


def on_surface(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, seed: int = 0) -> np.ndarray:
    """A random point of the triangle that is nearest to each point (n, 3)."""
    import igl

    nearest = np.asarray(igl.point_mesh_squared_distance(np.asarray(points, np.float64), vertices, faces)[1]).ravel()
    u, v = np.random.default_rng(seed).random((2, len(points)))
    root = np.sqrt(u)
    a, b, c = vertices[faces[nearest]].transpose(1, 0, 2)
    return a * (1 - root)[:, None] + b * (root * (1 - v))[:, None] + c * (root * v)[:, None]


def rmsd(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Root mean square distance of points (n, 3) to the nearest barycentre of a triangle."""
    from scipy.spatial import cKDTree

    return float(np.sqrt(np.mean(cKDTree(vertices[faces].mean(axis=1)).query(points)[0] ** 2)))
