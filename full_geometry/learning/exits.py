"""Walks inside one object, from where light is seen to leave back to where it entered: samples of S mu_i.

A walk begins at x_o, goes inwards along the refracted w_o with the weight F_t(mu_o), is scattered, is reflected at the
boundary from inside, and leaves at x_i along w_i with the throughput T of each channel. Then

    L_o(x_o, w_o) = E[T L_i(x_i, w_i)],    E[T delta(x - x_i, w - w_i)] = S(x, w; x_o, w_o) mu.

Lanes that are done begin the next walk. A visitor says what is recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from full_geometry.subject import Subject, SurfacePoint, clearance, refract_in
from halfspace_sss.checks import check_count
from halfspace_sss.rendering.transport.plane import number
from halfspace_sss.rendering.walk.inside import fly, free_path, roulette, turn
from halfspace_sss.tracing.walk import _generator, pass_seed

__all__ = ["LANES", "Exits", "Left", "Visitor", "trace_exits", "walk_inside"]

LANES = 2**15


class Left(NamedTuple):
    """A walk that leaves: its number, where and whereto, throughput per channel, scattering events, the face there."""

    walk: Any
    at: SurfacePoint
    T: Any
    order: Any
    face: Any


class Visitor(Protocol):
    """What is recorded of walks; it is called once for a walk that leaves, never for one that ends inside."""

    def leave(self, left: Left) -> None:
        """Record it, by scattering to memory."""


class Exits(NamedTuple):
    """Ends of walks, one lane for each: T is 0 where it ended inside, left at an order that is not kept, or below the
    horizon of the shading normal."""

    at: SurfacePoint
    T: Any
    order: Any
    face: Any


class _Store:
    """A visitor that keeps the end of every walk."""

    def __init__(self, n: int, fewest: int, most: int) -> None:
        import drjit as dr
        import mitsuba as mi

        at = SurfacePoint(*(dr.zeros(kind, n) for kind in (mi.Point3f, mi.Normal3f, mi.Normal3f, mi.Vector3f)))
        self.exits = Exits(at, dr.zeros(mi.Spectrum, n), dr.zeros(mi.UInt32, n), dr.zeros(mi.UInt32, n))
        self.fewest, self.most = (dr.opaque(mi.UInt32, order) for order in (fewest, most))
        dr.eval(self.exits)

    def leave(self, left: Left) -> None:
        import drjit as dr

        kept = (left.order >= self.fewest) & (left.order <= self.most) & (dr.dot(left.at.w, left.at.n_out) > 0)
        targets, values = (*self.exits.at, *self.exits[1:]), (*left.at, *left[2:])
        for target, value in zip(targets, values):
            dr.scatter(target, value, left.walk, kept)


def trace_exits(
    subject: Subject, starts: SurfacePoint, seed: tuple[int, ...], *, fewest: int = 2, most: int = 2**31 - 1
) -> Exits:
    """One walk from each start.

    Args:
        starts: where light is seen to leave, and the direction towards the eye.
        seed: of the pass, as for `walk.pass_seed`.
        fewest, most: numbers of scattering events that are kept.
    """
    import drjit as dr

    check_count("fewest", fewest, 0)
    store = _Store(dr.width(starts.p), fewest, most)
    walk_inside(subject, starts, store, seed)
    dr.eval(store.exits)
    return store.exits


def walk_inside(subject: Subject, starts: SurfacePoint, visitor: Visitor, seed: tuple[int, ...]) -> None:
    """Walks from all starts, in a loop whose lanes begin the next walk when one ends."""
    import drjit as dr
    import mitsuba as mi

    n = dr.width(starts.p)
    lanes = min(LANES, n)
    dr.eval(starts)
    walker = _Walker(subject, starts, visitor, lanes)
    state = walker.begin(dr.arange(mi.UInt32, lanes), _generator(mi, lanes, pass_seed(*seed)))
    total = dr.opaque(mi.UInt32, n)

    def body(s: dict) -> tuple[dict]:
        s = dr.if_stmt((s,), s["alive"], walker.step, lambda s: s, label="inside")
        return (dr.if_stmt((s,), ~s["alive"], walker.renew, lambda s: s, label="renew"),)

    dr.while_loop((state,), lambda s: s["walk"] < total, body, label="exits")
    dr.eval()


@dataclass(frozen=True, eq=False)
class _Walker:
    subject: Subject
    starts: SurfacePoint
    visitor: Visitor
    lanes: int

    def begin(self, walk: Any, rng: Any) -> dict:
        """The state at the start of walks."""
        import drjit as dr
        import mitsuba as mi

        at = self.starts.gather(dr.minimum(walk, dr.width(self.starts.p) - 1))
        d, F_t, valid = refract_in(at, number(self.subject.eta))
        channels = len(mi.Spectrum(0))
        channel = dr.minimum(mi.UInt32(rng.next_float32() * channels), channels - 1)
        return {
            "walk": walk, "alive": mi.Bool(valid), "o": mi.Point3f(at.p), "d": d, "skip": clearance(at.p, at.n, d),
            "weight": mi.Spectrum(F_t), "density": dr.full(mi.Spectrum, 1, self.lanes),
            "channel": channel, "order": dr.zeros(mi.UInt32, self.lanes), "rng": rng,
        }  # fmt: skip

    def renew(self, s: dict) -> dict:
        return self.begin(s["walk"] + self.lanes, s["rng"])

    def step(self, s: dict) -> dict:
        """A free flight to a scattering event, or to the boundary."""
        import drjit as dr
        import mitsuba as mi

        m = self.subject.coefficients
        t = free_path(m, s["channel"], s["rng"].next_float32())
        ray = mi.Ray3f(s["o"] + s["d"] * s["skip"], s["d"])
        ray.maxt = t - s["skip"]
        hit = self.subject.found.scene.ray_intersect_preliminary(ray, coherent=False)
        flight = fly(m, s["weight"], s["density"], s["channel"], t, hit.t + s["skip"])
        s = {**s, "weight": flight.weight, "density": flight.density}
        s = dr.if_stmt((s, t), flight.scatters, self._scatter, lambda s, *rest: s, label="scatter")
        return dr.if_stmt((s, ray, hit), ~flight.scatters, self._boundary, lambda s, *rest: s, label="boundary")

    def _scatter(self, s: dict, t: Any) -> dict:
        import drjit as dr
        import mitsuba as mi

        rng, o = s["rng"], mi.Point3f(s["o"] + s["d"] * t)
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        d, weight, density = turn(
            self.subject.coefficients, s["weight"], s["density"], s["channel"], s["d"], u, self.subject.same_g
        )
        order = s["order"] + 1
        scale = dr.select(order < 2, mi.Float(dr.inf), 1)  # at low albedo few walks would get to the orders that count
        survives, weight = roulette(weight, scale, rng.next_float32())
        return {**s, "o": o, "d": d, "weight": weight, "density": density, "order": order,
                "skip": mi.Float(0), "alive": survives & self.subject.box.contains(o)}  # fmt: skip

    def _boundary(self, s: dict, ray: Any, hit: Any) -> dict:
        """Reflection at the boundary seen from inside, or the way out."""
        import drjit as dr
        import mitsuba as mi

        rng, sign = s["rng"], number(self.subject.found.sign)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame)
        n, n_out = si.n * sign, si.sh_frame.n * sign
        si.n, si.sh_frame = n, mi.Frame3f(n_out)
        si.wi = si.to_local(-ray.d)
        leaked = dr.dot(n, ray.d) < 0  # rounding has put the walk outside
        u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        bs, value = self.subject.boundary.sample(mi.BSDFContext(mi.TransportMode.Importance), si, u, v)
        d = si.to_world(bs.wo)
        weight = s["weight"] * value
        out = (dr.dot(d, n) > 0) & ~leaked & si.is_valid()
        left = Left(
            s["walk"],
            SurfacePoint(mi.Point3f(si.p), mi.Normal3f(n), mi.Normal3f(n_out), d),
            weight,
            s["order"],
            si.prim_index,
        )
        (_,) = dr.if_stmt((left,), out, self._leave, lambda left: (mi.Bool(False),), label="leave")
        alive = ~out & ~leaked & si.is_valid() & (bs.pdf > 0)
        return {**s, "o": mi.Point3f(si.p), "d": d, "weight": weight, "alive": alive, "skip": clearance(si.p, n, d)}

    def _leave(self, left: Left) -> tuple:
        import mitsuba as mi

        self.visitor.leave(left)
        return (mi.Bool(True),)
