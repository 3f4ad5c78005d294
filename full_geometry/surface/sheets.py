"""Thin walls: a `translucent` surface with a thickness, on an open sheet such as a leaf, paper or a lamp shade.

Light passes where it arrives, as through a slab in air whose sides are no distance apart:

    f_r = F_t(mu_i) F_t(mu_o) / eta² (K_r + M_r),  f_t likewise,

K_r and K_t of light that is scattered once, M_r and M_t of all other, from tables of
`physics.reflectance.slab_kernels`. Beside these are two deltas, of light that no event scatters: with E = exp(-t / mu)
and F of the boundary F + (1 - F)² F E² / (1 - F² E²) is mirrored and (1 - F)² E / (1 - F² E²) goes straight on.
"""

from __future__ import annotations

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.interpolate import CubicSpline

from full_geometry.geometry.points import floats, opaque
from full_geometry.geometry.shape import name_of
from full_geometry.settings import check_parameters, per_variant
from full_geometry.surface.textured import TexturedMedium
from full_geometry.surface.translucent import PARAMETERS, boundary_of, is_smooth_boundary, number_of, read_medium_spec
from halfspace_sss.arrays import library
from halfspace_sss.checks import check_interval
from halfspace_sss.physics.fresnel import F_r, F_t, mu_internal
from halfspace_sss.physics.medium import Medium, eval_hg, sample_hg
from halfspace_sss.physics.reflectance import LARGEST_G, slab_kernels
from halfspace_sss.tracing.walk import turn

THICKNESS = (1e-6, 1e6)  # mm
OPTICAL = (1e-6, 1e6)  # thickness
COSINES, AZIMUTHS = 32, 17  # of tables
NODES = 48  # of the solver
SMALLEST_WAVE, MOST_WAVES = 1e-3, 16  # of Fourier series over azimuth: the last one of light scattered twice
ALBEDOS = 17  # of tables under a texture, even in s = sqrt((1 - a) / (1 - g a))
OF_SOLIDS = ("model", "orders", "priority", "layers")
KINDS = ("DeltaReflection", "DeltaTransmission", "DiffuseReflection", "DiffuseTransmission")  # of components
MIRRORED, STRAIGHT, REFLECTED, TRANSMITTED = range(4)


class SlabTable:
    """M_r and M_t over albedo by azimuth and both internal cosines, and the scattered fluxes over albedo by one.
    `albedos`: of single scattering, falling; one, or those even in s. `g`, `tau`, `eta`: mean cosine, optical thickness
    and index."""

    def __init__(self, albedos: np.ndarray, g: float, tau: float, eta: float) -> None:
        cosines, azimuths = np.linspace(math.sqrt(1 - 1 / eta**2), 1, COSINES), np.linspace(0, np.pi, AZIMUTHS)
        waves = math.ceil(math.log(SMALLEST_WAVE) / math.log(max(g * g, SMALLEST_WAVE)))
        pairs, single = [], []
        for albedo in np.maximum(albedos, 1e-4).tolist():
            made = slab_kernels(albedo, g, tau, eta, azimuths, min(waves, MOST_WAVES), NODES)
            both = np.stack([made.reflected, made.transmitted], axis=-1) / albedo
            pairs += list(CubicSpline(made.mu, CubicSpline(made.mu, both, axis=1)(cosines), axis=2)(cosines))
            fluxes = np.stack([made.reflectance, made.transmittance], axis=-1) / albedo
            single.append(CubicSpline(made.mu, fluxes)(cosines))
        self.planes = len(pairs)
        self.pairs = mi.Texture3f(_tensor(pairs), use_accel=False, wrap_mode=dr.WrapMode.Clamp)
        self.fluxes = mi.Texture2f(_tensor(single), use_accel=False, wrap_mode=dr.WrapMode.Clamp)
        self.straight, self.normal = made.straight / tau, float(np.mean(single[0][-1]))

    def more(self, i: mi.Float, o: mi.Float, azimuth: mi.Float, at: mi.Float) -> list[mi.Float]:
        """M_r and M_t over albedo; all but `azimuth`, over pi, are places in the tables, `at` that of the albedo."""
        plane = azimuth * (AZIMUTHS - 1) + 0.5
        first = dr.clip(dr.floor(at), 0, max(self.planes // AZIMUTHS - 2, 0))
        found = [
            self.pairs.eval(mi.Point3f(i, o, (plane + step * AZIMUTHS + first * AZIMUTHS) / self.planes))
            for step in range(1 if self.planes == AZIMUTHS else 2)
        ]
        return found[0] if len(found) == 1 else [dr.lerp(a, b, at - first) for a, b in zip(*found)]


def _tensor(values: list[np.ndarray]) -> mi.TensorXf:
    return mi.TensorXf(floats(np.maximum(values, 0)), np.shape(values))


class Sheet:
    """What a slab does to light, for one direction or two, by channel.
    `medium`: with a value for each channel, 1/mm. `textured`: its albedo over the surface, or None. `thickness`: mm.
    `reflects`: whether the boundary mirrors from outside. ValueError if g or the optical thickness is out of range."""

    def __init__(self, medium: Medium, textured: TexturedMedium | None, thickness: float, reflects: bool) -> None:
        self.eta, self.textured, self.reflects = float(medium.eta), textured, reflects
        self.g, sigma_t, albedo = (np.atleast_1d(getattr(medium, key)).tolist() for key in ("g", "sigma_t", "albedo"))
        self.tau, self.albedo, tables = [thickness * each for each in sigma_t], [opaque(a) for a in albedo], {}
        self.tables = []
        for g, tau, a in zip(self.g, self.tau, albedo):
            check_interval("thickness in mean free paths", tau, *OPTICAL)
            check_interval("g of a sheet", g, -LARGEST_G, LARGEST_G)
            s = np.linspace(0, 1, ALBEDOS)
            albedos = np.array([a]) if textured is None else (1 - s * s) / (1 - g * s * s)
            key = g, tau, None if textured is not None else a
            tables[key] = tables.get(key) or SlabTable(albedos, g, tau, self.eta)
            self.tables.append(tables[key])
        self.mean_g = opaque(float(np.mean(self.g)))
        self.index, self.least = opaque(self.eta), opaque(math.sqrt(1 - 1 / self.eta**2))
        self.phase = [opaque(g) for g in self.g]
        self.depth = [opaque(tau) for tau in self.tau]
        # scattered light is drawn as if by one event as often as it is of one
        shares = [
            min(-math.expm1(-tau) * math.exp(-tau * (1 - g)) / max(2 * table.normal, 1e-6), 1.0)
            for g, tau, table in zip(self.g, self.tau, self.tables)
        ]
        self.once = opaque(0.9 * float(np.mean(shares)))
        self.cut = [opaque(tau * table.straight) for tau, table in zip(self.tau, self.tables)]

    def albedos(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Float]:
        return self.albedo if self.textured is None else list(self.textured.albedo_at(si, active))

    def _at(self, channel: int, albedo: mi.Float) -> mi.Float:
        """Where an albedo is in the tables of a channel, from 0 on."""
        if self.textured is None:
            return mi.Float(0)
        return dr.safe_sqrt((1 - albedo) / (1 - self.phase[channel] * albedo)) * (ALBEDOS - 1)

    def _along(self, mu: mi.Float) -> mi.Float:
        """Where an internal cosine is in the tables."""
        return (dr.clip((mu - self.least) / dr.maximum(1 - self.least, 1e-6), 0, 1) * (COSINES - 1) + 0.5) / COSINES

    def unscattered(self, mu: mi.Float) -> tuple[mi.Spectrum, mi.Spectrum]:
        """What is mirrored and what goes straight on, at an external cosine."""
        F, T, inside = F_r(mu, self.index), F_t(mu, self.index), mu_internal(mu, self.index)
        E = [dr.exp(-t / dr.maximum(inside, 1e-6)) for t in self.cut]
        through = [dr.square(T) * e / (1 - dr.square(F * e)) for e in E]
        first = F if self.reflects else 0 * F
        return mi.Spectrum([first + F * e * t for e, t in zip(E, through)]), mi.Spectrum(through)

    def scattered(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Spectrum]:
        """The fractions of light along si.wi that leave scattered, on its side and on the other."""
        mu = dr.abs(mi.Frame3f.cos_theta(si.wi))
        v, T = self._along(mu_internal(mu, self.index)), F_t(mu, self.index)
        found = []
        for k, albedo in enumerate(self.albedos(si, active)):
            table, rows = self.tables[k], 1 if self.textured is None else ALBEDOS
            values = table.fluxes.eval(mi.Point2f(v, (self._at(k, albedo) + 0.5) / rows))
            found.append([T * albedo * value for value in values])
        return tuple(mi.Spectrum(list(each)) for each in zip(*found))

    def bsdf(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """f of scattered light, 1/sr."""
        mu_i, mu_o = (dr.abs(mi.Frame3f.cos_theta(w)) for w in (si.wi, wo))
        i, o = (dr.maximum(mu_internal(mu, self.index), 1e-4) for mu in (mu_i, mu_o))
        same = si.wi.z * wo.z > 0
        before, after = self._inside(si.wi, wo)
        cosine, flat = dr.dot(before, after), before.x * after.x + before.y * after.y
        long = dr.sqrt((dr.square(before.x) + dr.square(before.y)) * (dr.square(after.x) + dr.square(after.y)))
        azimuth = dr.acos(dr.clip(flat / dr.maximum(long, 1e-8), -1, 1)) * dr.inv_pi
        found, at = [], (self._along(i), self._along(o))
        for k, albedo in enumerate(self.albedos(si, active)):
            t, more = self.depth[k], self.tables[k].more(*at, azimuth, self._at(k, albedo))
            # K_r = a p (1 - e^(-t (1/i + 1/o))) / (i + o), K_t = a p (e^(-t/o) - e^(-t/i)) / (o - i)
            back = -library(t).expm1(-t * (dr.rcp(i) + dr.rcp(o))) / (i + o)
            x = t * (o - i) / (i * o)
            through = t * dr.exp(-t / dr.maximum(i, o)) / (i * o) * _mean_decay(dr.abs(x))
            once = albedo * eval_hg(cosine, self.phase[k]) * dr.select(same, back, through)
            found.append(once + albedo * dr.select(same, more[0], more[1]))
        factor = F_t(mu_i, self.index) * F_t(mu_o, self.index) / dr.square(self.index)
        return dr.select(active, mi.Spectrum(found) * factor, 0)

    def _inside(self, wi: mi.Vector3f, wo: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """The refracted directions in which light travels before and after an event."""
        results = []
        for w, sign in ((wi, -1), (wo, 1)):
            mu = mu_internal(dr.abs(w.z), self.index)
            results.append(sign * mi.Vector3f(w.x / self.index, w.y / self.index, dr.mulsign(mu, w.z)))
        return tuple(results)

    def sample(self, si: mi.SurfaceInteraction3f, turned: mi.Float, u: mi.Point2f, ahead: mi.Float) -> mi.Vector3f:
        """A direction of scattered light.
        `si`: where, with wi. `turned`: uniform number, which chooses between a cosine and the phase function. `u`:
        uniform numbers. `ahead`: share of the other side."""
        share = self.once
        by_phase, v = turned < share, (turned - share) / dr.maximum(1 - share, 1e-6)
        flat = mi.warp.square_to_cosine_hemisphere(u)
        flat.z *= dr.mulsign(dr.select(v < ahead, mi.Float(-1), 1), si.wi.z)
        before, _ = self._inside(si.wi, si.wi)
        d = mi.Vector3f(*turn(before.x, before.y, before.z, sample_hg(u.x, self.mean_g), 2 * dr.pi * u.y))
        x, y = d.x * self.index, d.y * self.index
        out = mi.Vector3f(x, y, dr.mulsign(dr.safe_sqrt(1 - x * x - y * y), d.z))
        return dr.select(by_phase, out, flat)

    def pdf(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, ahead: mi.Float) -> mi.Float:
        """The density of `sample`, 1/sr."""
        share, mu = self.once, dr.abs(wo.z)
        side = dr.select(si.wi.z * wo.z > 0, 1 - ahead, ahead)
        inner = dr.maximum(mu_internal(mu, self.index), 1e-4)
        by_phase = eval_hg(dr.dot(*self._inside(si.wi, wo)), self.mean_g) * mu / (dr.square(self.index) * inner)
        return (1 - share) * side * mu * dr.inv_pi + share * by_phase


def _mean_decay(x: mi.Float) -> mi.Float:
    """(1 - e^-x) / x for x >= 0."""
    return dr.select(x < 1e-6, 1, -library(x).expm1(-x) / dr.maximum(x, 1e-6))


def is_sheet(bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF is a thin wall, or holds one."""
    return bsdf is not None and any(isinstance(node, sheet_class()) for node in mi.traverse(bsdf).hierarchy)


def check_sheets(shapes: list[mi.Shape], mm_per_unit: float) -> None:
    """ValueError if a sheet is thicker than its object is wide, the square root of its area."""
    for shape in shapes:
        for node in mi.traverse(shape.bsdf()).hierarchy if shape.bsdf() is not None else ():
            if isinstance(node, sheet_class()):
                wide = mm_per_unit * math.sqrt(float(np.max(np.array(shape.surface_area()))))
                if not node.thickness < wide:
                    raise ValueError(
                        f"thickness of object {name_of(shape)} must be below its width of {wide:.4g} mm, got "
                        f"{node.thickness:g} mm"
                    )


@per_variant
def sheet_class() -> type:
    """The class of thin walls for the current variant of Mitsuba."""

    class TranslucentSheet(mi.BSDF):
        """A slab without extent, seen from both sides."""

        def __init__(self, props: mi.Properties) -> None:
            mi.BSDF.__init__(self, props)
            self.thickness = number_of(props, "thickness")
            self.sheet = _read_sheet(props, self.thickness)
            sides = int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
            self.m_components = [int(getattr(mi.BSDFFlags, kind)) | sides for kind in KINDS]
            self.m_flags = functools.reduce(int.__or__, self.m_components)

        def _shares(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, active: mi.Bool
        ) -> tuple[list[mi.Float], tuple[mi.Spectrum, mi.Spectrum]]:
            """The probability of each component, and the weights of both deltas."""
            deltas = self.sheet.unscattered(dr.abs(mi.Frame3f.cos_theta(si.wi)))
            asked = [ctx.is_enabled(getattr(mi.BSDFFlags, kind), k) for k, kind in enumerate(KINDS)]
            sizes = [dr.mean(each) for each in (*deltas, *self.sheet.scattered(si, active))]
            sizes = [size if each else mi.Float(0) for size, each in zip(sizes, asked)]
            total = dr.maximum(sum(sizes), 1e-10)
            return [size / total for size in sizes], deltas

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            shares, (mirrored, straight) = self._shares(ctx, si, active)
            mirrors, diffuse = u < shares[MIRRORED], u >= shares[MIRRORED] + shares[STRAIGHT]
            scattered = shares[REFLECTED] + shares[TRANSMITTED]
            rest = (u - shares[MIRRORED] - shares[STRAIGHT]) / dr.maximum(scattered, 1e-10)
            ahead = shares[TRANSMITTED] / dr.maximum(scattered, 1e-10)
            w = self.sheet.sample(si, rest, v, ahead)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(diffuse, w, dr.select(mirrors, mi.reflect(si.wi), -si.wi))
            delta = dr.select(mirrors, shares[MIRRORED], shares[STRAIGHT])
            bs.pdf = dr.select(diffuse, scattered * self.sheet.pdf(si, w, ahead), delta)
            passes = si.wi.z * w.z < 0
            drawn = dr.select(passes, mi.UInt32(TRANSMITTED), REFLECTED)
            number = dr.select(diffuse, drawn, dr.select(mirrors, mi.UInt32(MIRRORED), STRAIGHT))
            bs.sampled_component, bs.eta = number, mi.Float(1)
            for k, kind in enumerate(KINDS):
                bs.sampled_type = dr.select(number == k, mi.UInt32(int(getattr(mi.BSDFFlags, kind))), bs.sampled_type)
            value = self._bsdf(ctx, si, w, active) * dr.abs(w.z)
            value = dr.select(diffuse, value, dr.select(mirrors, mirrored, straight))
            bs.pdf = dr.select(active, bs.pdf, 0)
            return bs, dr.select(bs.pdf > 0, value / dr.maximum(bs.pdf, 1e-20), 0)

        def _bsdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
        ) -> mi.Spectrum:
            same = si.wi.z * wo.z > 0
            there = (ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, REFLECTED),
                     ctx.is_enabled(mi.BSDFFlags.DiffuseTransmission, TRANSMITTED))  # fmt: skip
            return self.sheet.bsdf(si, wo, active & dr.select(same, *map(mi.Bool, there)))

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            return self._bsdf(ctx, si, wo, active) * dr.abs(wo.z)

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            shares, _ = self._shares(ctx, si, active)
            scattered = shares[REFLECTED] + shares[TRANSMITTED]
            ahead = shares[TRANSMITTED] / dr.maximum(scattered, 1e-10)
            return dr.select(active, scattered * self.sheet.pdf(si, wo, ahead), 0)

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return sum(self.sheet.scattered(si, active)) & active

        def to_string(self) -> str:
            return f"TranslucentSheet[thickness = {self.thickness:g} mm]"

    return TranslucentSheet


def _read_sheet(props: mi.Properties, thickness: float) -> Sheet:
    """A thin wall from the parameters of a `translucent` surface."""
    inside = [(key, each) for key, each in props.objects() if isinstance(each, mi.BSDF)]
    check_parameters("translucent", props, (*PARAMETERS, "thickness", *(key for key, _ in inside)))
    check_interval("thickness", thickness, *THICKNESS)
    for key in OF_SOLIDS:
        if key in props:
            raise ValueError(f"{key} must be left out of a surface with a thickness, got {props[key]!r}")
    if mi.is_spectral:
        raise ValueError(f"thickness must be left out under a spectral variant, got {thickness:g}")
    spec = read_medium_spec(props)
    if spec.varying is not None or (spec.textured is not None and isinstance(spec.textured.sigma_t, mi.Texture)):
        raise ValueError("the medium of a surface with a thickness must have constants but for its albedo, got others")
    eta = spec.medium.eta
    if not eta >= 1:
        raise ValueError(f"eta of a surface with a thickness must be >= 1, got {eta:g}")
    if not is_smooth_boundary(boundary_of([each for _, each in inside], eta)):
        raise ValueError("the boundary of a surface with a thickness must be smooth and without tints, got another")
    return Sheet(spec.medium, spec.textured, thickness, spec.reflection)
