"""The network of TG et al. 2023 for one object under distant light, (x_o, w_o, w_l) -> radiance, and its images.

f(x_o, w_o, w_l) is the radiance that leaves at x_o along w_o under light of irradiance 1, across its direction, from
w_l. Environments are sums over directions, L_o = sum_k f(x_o, w_o, w_k) E_k; a lamp close by is its direction and
irradiance at the object's centre. Light of the surroundings is seen from that centre, without the object.

A multilayer perceptron with skip connections: 3 layers of 256, as the paper states none, each of which sees the input
again. Walks from x_o along w_o leave for good along w with the throughput T, so that E[T delta(w - w_l)] is f, and

    E[ 4 pi f(x_o, w_o, w')² - 2 T f(x_o, w_o, w) ],    w' uniform,

is, up to a constant, the squared error over all directions of light: path tracing under all distant lights at once.
Light that meets the object again goes on there, by refraction; what the boundary mirrors is no part of f.

Source: TG, Frisvad, Ramamoorthi and Jensen: Neural BSSRDF: Object Appearance Representation Including Heterogeneous
Scattering, arXiv 2312.15711.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import nn

from benchmarks.fits import ADAM, CpuSchedule, Objective
from full_geometry.geometry.points import SurfacePoint, place, surface_point, turned
from full_geometry.geometry.rounding import ray_from
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.exit_pairs import trace_exits
from halfspace_sss.neural.training.fit import Descent, Source, fit
from halfspace_sss.progress import NamedProgress
from halfspace_sss.tracing.walk import generator, pass_seed

WIDTH, DEPTH = 256, 3
PASSES = 4  # of light through the object, at most
CHUNK, BATCH, BESIDE = 2**15, 512, 2  # walks of a pass, of a step; uniform directions w' beside each
RATE, WARM = 2e-3, 50  # the largest rate, and steps over which it rises
DIRECTIONS, RAYS = 192, 2**16  # of an environment; that look at it


class DistantWalks(NamedTuple):
    """Exits and directions (n, 9): x_o over the object's radius, w_o, w; and T (n, channels), 0 of what is lost."""

    x: np.ndarray
    T: np.ndarray


class DistantLight(nn.Module):
    """f of an object.

    Args:
        centre, radius: of the object.
        scale: of f in each channel.
        seed: of the initial weights.
    """

    def __init__(self, centre: np.ndarray, radius: float, scale: np.ndarray, seed: int = 0) -> None:
        super().__init__()
        self.centre, self.radius = centre, radius
        self.register_buffer("scale", torch.from_numpy(np.asarray(scale, dtype=np.float32)))
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.hidden = nn.ModuleList([nn.Linear(9 + (WIDTH if k else 0), WIDTH) for k in range(DEPTH)])
            self.last = nn.Linear(9 + WIDTH, len(scale))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """f over its scale (n, channels) for inputs (n, 9)."""
        y = x
        for k, layer in enumerate(self.hidden):
            y = nn.functional.leaky_relu(layer(torch.cat((x, y), dim=1) if k else x))
        return nn.functional.softplus(self.last(torch.cat((x, y), dim=1)))

    def inputs(self, p: np.ndarray, w_o: np.ndarray) -> np.ndarray:
        """Inputs but for the light, (n, 6), of points and directions (n, 3)."""
        return np.concatenate([(p - self.centre) / self.radius, w_o], axis=1).astype(np.float32)

    def radiance(self, p: np.ndarray, w_o: np.ndarray, lights: np.ndarray, E: np.ndarray) -> np.ndarray:
        """Radiance (n, channels) at points along w_o (n, 3), under lights (k, 3) of irradiance E (k, channels)."""
        known = torch.from_numpy(self.inputs(p, w_o))
        total = torch.zeros(len(known), len(self.scale))
        with torch.no_grad():
            for w, each in zip(torch.from_numpy(lights.astype(np.float32)), torch.from_numpy(E.astype(np.float32))):
                total += each * self(torch.cat((known, w.expand(len(known), 3)), dim=1))
            return (total * self.scale).numpy()

    @property
    def kilobytes(self) -> float:
        """Of its weights in half precision."""
        return 2 * sum(v.numel() for v in self.parameters()) / 1000


def distant_walks(obj: TranslucentObject, exits: SurfacePoint, seed: tuple[int, ...]) -> DistantWalks:
    """A walk from each exit, until its light comes from afar."""
    at, n = exits, dr.width(exits.p)
    T, lost, sign = mi.Spectrum(1), mi.Bool(False), obj.geometry.sign
    w, gone = dr.zeros(mi.Vector3f, n), dr.full(mi.Bool, False, n)
    for k in range(PASSES):
        ends = trace_exits(obj, at, (*seed, k), fewest=0)
        T = dr.select(gone, T, T * ends.T)
        ray = ray_from(place(ends.at.p, ends.at.n), ends.at.w, obj.geometry.clearance)
        si = obj.geometry.scene.ray_intersect(ray, mi.RayFlags.All, False, ~gone & ~lost)
        meets = si.is_valid() & (dr.dot(si.n * sign, ray.d) < 0)
        w = dr.select(gone, w, ends.at.w)
        gone |= ~meets
        again = surface_point(si.p, mi.Normal3f(si.n * sign), mi.Normal3f(turned(si.sh_frame.n, si.n) * sign), -ray.d)
        at = SurfacePoint(*(dr.select(gone, a, b) for a, b in zip(exits[:4], again[:4])))
        dr.eval(T, w, gone, at)
    T = dr.select(gone, T, 0)
    columns = [*_numbers(exits.p, n), *_numbers(exits.w, n), *_numbers(w, n)]
    return DistantWalks(np.stack(columns, axis=1), np.stack(_numbers(T, n), axis=1))


def _numbers(values: Sequence[mi.Float], n: int) -> list[np.ndarray]:
    return [np.broadcast_to(np.array(v, dtype=np.float32), n) for v in values]


def fit_distant(
    obj: TranslucentObject, seconds: float, seed: int = 0, steps: int | None = None,
    progress: NamedProgress | None = None,
) -> DistantLight:  # fmt: skip
    """The network of an object after so many CPU seconds, walks included.

    Args:
        obj: the object.
        seconds: of CPU time.
        seed: of everything.
        steps: instead of the seconds.
        progress: called with (what, done, total).
    """
    box = obj.geometry.scene.bbox()
    low, high = (np.ravel(np.array(v, dtype=float)) for v in (box.min, box.max))
    first = _pass(obj, seed, 0)
    scale = np.maximum(first.T.mean(axis=0), 1e-6) / (4 * np.pi)
    net = DistantLight((low + high) / 2, float(np.linalg.norm(high - low)) / 2, scale, seed)

    def loss(batch: tuple[torch.Tensor, ...]) -> torch.Tensor:
        x, T, other = batch
        n, many = len(x), torch.cat([x, torch.cat((x[:, :6].repeat(BESIDE, 1), other), dim=1)])
        f = net(many)
        return torch.square(f[n:]).mean() - 2 * (T / (4 * np.pi * net.scale) * f[:n]).mean()

    learner, schedule = Objective(net, loss), CpuSchedule(seconds, steps, RATE, WARM, 0.02)
    fit(learner, _batches(obj, net, seed), schedule, seed, progress=progress, descent=Descent(learner, betas=ADAM))
    return net


def _pass(obj: TranslucentObject, seed: int, k: int) -> DistantWalks:
    return distant_walks(obj, obj.random_points(generator(mi, CHUNK, pass_seed(seed, 21, k))), (seed, 22, k))


def _batches(obj: TranslucentObject, net: DistantLight, seed: int) -> Source:
    rng = np.random.default_rng([seed, 23])

    def batches() -> Iterator[tuple[torch.Tensor, ...]]:
        for k in count():
            walks = _pass(obj, seed, k)
            x = np.concatenate([net.inputs(walks.x[:, :3], walks.x[:, 3:6]), walks.x[:, 6:]], axis=1)
            for rows in np.array_split(rng.permutation(CHUNK), CHUNK // BATCH):
                other = rng.standard_normal((BESIDE * len(rows), 3))
                other /= np.linalg.norm(other, axis=1, keepdims=True)
                yield tuple(torch.from_numpy(v.astype(np.float32)) for v in (x[rows], walks.T[rows], other))

    source = batches()
    return lambda _: next(source)


# ---- Images ---------------------------------------------------------------------------------------------------------


def incident(scene: mi.Scene, centre: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Directions (k, 3) of the light of a scene at a point, and their irradiance (k, channels)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, RAYS)
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(centre.tolist()), d))
    L = np.array(scene.integrator().sample(scene, sampler, ray)[0], dtype=float).T
    k = np.arange(DIRECTIONS) + 0.5
    up, azimuth = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    side = np.sqrt(1 - up * up)
    cells = np.stack([side * np.cos(azimuth), up, side * np.sin(azimuth)], axis=1)
    nearest = (np.array(d).T @ cells.T).argmax(axis=1)
    E = np.stack([np.bincount(nearest, L[:, c], DIRECTIONS) for c in range(L.shape[1])], axis=1)
    return cells, E * 4 * np.pi / RAYS


def lamp(scene: mi.Scene, centre: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The light of a scene at a point as from one direction (1, 3): the mean one, and all irradiance (1, channels)."""
    directions, E = incident(scene, centre, seed)
    mean = (directions * E.sum(axis=1, keepdims=True)).sum(axis=0)
    return (mean / np.linalg.norm(mean))[None], E.sum(axis=0, keepdims=True)


def image(
    scene: mi.Scene, name: str, net: DistantLight, lights: np.ndarray, E: np.ndarray, spp: int, seed: int = 0
) -> np.ndarray:
    """What the network shows of an object: radiance times its share of each pixel, (H, W, channels).

    Args:
        scene: with a sensor.
        name: of the object in it.
        net: of the object.
        lights, E: directions (k, 3) and their irradiance (k, channels).
        spp: samples a pixel.
        seed: of their places in the pixel.
    """
    sensor = scene.sensors()[0]
    size = np.ravel(np.array(sensor.film().crop_size()))
    pixels = np.repeat(np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2), spp, axis=0)
    u = (pixels + np.random.default_rng([seed, 31]).random(pixels.shape)) / size
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(u.T.astype(np.float32)), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    shape = next(shape for shape in scene.shapes() if shape.id() == name)
    seen = np.flatnonzero(np.array(si.is_valid() & (si.shape == mi.ShapePtr(shape))))
    p, w_o = np.array(si.p).T[seen], -np.array(ray.d).T[seen]
    result = np.zeros((len(pixels), E.shape[1]))
    result[seen] = net.radiance(p, w_o, lights, E)
    return result.reshape(size[1], size[0], spp, -1).mean(axis=2).astype(np.float32)
