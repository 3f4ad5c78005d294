"""From a pair of surface points to a query of the half-space: the one place where directions are translated."""

from __future__ import annotations

from typing import Any, NamedTuple

__all__ = ["GEOMETRIES", "Exit", "Frame", "local_frame", "number", "place", "plane_query", "separation"]

GEOMETRIES = ("distance", "tangent")


class Exit(NamedTuple):
    """Where light leaves: position, outward normal, w_o, which points away from the surface (Mitsuba's wi)."""

    p: Any
    n: Any
    w: Any
    sign: Any = None  # that turns the normals of the shape outwards
    n_face: Any = None  # outward geometric normal


class Frame(NamedTuple):
    """Tangents and normal at a point; `t` follows x_i -> x_o."""

    t: Any
    b: Any
    n: Any

    def azimuth(self, w: Any) -> Any:
        """Azimuth of w about the normal from t, radians."""
        import drjit as dr

        return dr.atan2(dr.dot(w, self.b), dr.dot(w, self.t))

    def direction(self, mu: Any, phi: Any) -> Any:
        """The unit vector with cosine mu and azimuth phi."""
        import drjit as dr

        sine, (s, c) = dr.safe_sqrt((1 - mu) * (1 + mu)), dr.sincos(phi)
        return self.t * (sine * c) + self.b * (sine * s) + self.n * mu


def number(value: float) -> Any:
    """A number of a scene as data of a kernel, which then serves other materials and sizes too."""
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(mi.Float, float(value))


def place(p: Any, n: Any) -> Any:
    """A point with its geometric normal, from which rays start clear of the surface."""
    import drjit as dr
    import mitsuba as mi

    found = dr.zeros(mi.Interaction3f)
    found.p, found.n = mi.Point3f(p), mi.Normal3f(n)
    return found


def local_frame(n: Any, d: Any) -> Frame:
    """The frame of normal n whose first axis is d = x_o - x_i without its normal part; any axis where that is 0."""
    import drjit as dr
    import mitsuba as mi

    flat = d - n * dr.dot(n, d)
    length2 = dr.squared_norm(flat)
    spare, _ = mi.coordinate_system(n)
    t = dr.select(length2 > 1e-12 * dr.squared_norm(d), flat * dr.rsqrt(dr.maximum(length2, 1e-30)), spare)
    t = dr.normalize(t - n * dr.dot(n, t))
    return Frame(t, dr.cross(n, t), n)


def separation(p_i: Any, n_i: Any, p_o: Any, n_o: Any, geometry: str) -> Any:
    """Distance r of the half-space query, in scene units.

    "distance" takes |d|, d = x_o - x_i. "tangent" takes sqrt(d² - c (d.n)²), n along n_i + n_o and c = max(n_i.n_o, 0):
    the length of d in the common tangent plane where the normals are parallel, |d| where they are at right angles or
    turn away from each other, as on the two sides of something thin.
    """
    import drjit as dr

    d = p_o - p_i
    if geometry == "distance":
        return dr.norm(d)
    middle = n_i + n_o
    along = dr.square(dr.dot(d, middle)) / dr.maximum(dr.squared_norm(middle), 1e-12)
    return dr.sqrt(dr.maximum(dr.squared_norm(d) - dr.maximum(dr.dot(n_i, n_o), 0) * along, 0))


def plane_query(p_i: Any, n_i: Any, w_i: Any, out: Exit, geometry: str) -> tuple[Any, Any, Any, Any, Any]:
    """(r, mu_i, phi_i, mu_o, phi_o) of the half-space for light from w_i at p_i that leaves at `out`.

    r as in `separation`; each direction is taken against the normal of its own point, its azimuth from x_i -> x_o
    projected there. Cosines below the horizon come out as 0, at which every model is 0.
    """
    import drjit as dr

    d = out.p - p_i
    at_i, at_o = local_frame(n_i, d), local_frame(out.n, d)
    mu_i, mu_o = (dr.clip(dr.dot(w, n), 0, 1) for w, n in ((w_i, n_i), (out.w, out.n)))
    r = separation(p_i, n_i, out.p, out.n, geometry)
    return r, mu_i, at_i.azimuth(w_i), mu_o, at_o.azimuth(out.w)
