"""The Mitsuba surface `translucent`: which material, model and scattering orders an object has.

In a scene:

    {"type": "translucent", "material": "marble", "model": "directional_dipole"}

    <bsdf type="translucent">
        <string name="material" value="marble"/>
        <bsdf type="roughdielectric">
            <float name="alpha" value="0.1"/> <float name="int_ior" value="1.5"/> <float name="ext_ior" value="1"/>
        </bsdf>
    </bsdf>
    <bsdf type="translucent">
        <volume name="sigma_t" type="gridvolume"> <string name="filename" value="wax.vol"/> </volume>
        <string name="albedo" value="0.99, 0.97, 0.9"/>
    </bsdf>

Parameters, all optional but the medium:
    material: a name of the registry; or else `sigma_s`, `sigma_a` (1/mm; numbers, rgb, or strings of numbers separated
        by commas), `g` and `eta`; or `sigma_t` (1/mm), `albedo` and `scale` (a factor of sigma_t) instead of the
        first two. For a medium that varies in space `albedo` and one of `sigma_t` and `scale` may be a `gridvolume`.
        For one that varies over the surface `albedo` and `sigma_t` may be textures of Mitsuba; see `surface.textured`.
    layers: instead of these, layers below the surface, "NAME THICKNESS, ..., NAME" with names of materials and mm, or
        "skin I" to "skin VI": epidermis on dermis. One g and eta; see `surface.layered`.
    reflectance, mfp: instead of these, the reflectance of the half-space under even light and the mean free path (mm),
        numbers or textures. Values of textures are taken as they are, above 1 too.
    model: name of a model of the library, by default "neural"; "neural_shape", which sees the shape and needs no
        training; "full_geometry", S of this very object, which is learnt before its first render, or by
        `halfspace-sss train object`; "lambert", a diffuse surface of the same reflectance; or "auto", the cheapest of
        them that is within the `tolerance` of the integrator, by a measurement before the first render.
    orders: "total" (what the model lacks of the orders below two is traced; order 0 only beside a model that knows
        the object), "multiple" or "single".
    channel: R, G or B, or a number; under a mono variant, for a medium with channels.
    dilution: of a material that has one, see `halfspace_sss.materials.load`.
    a BSDF inside: the boundary, a `dielectric` or `roughdielectric` with int_ior / ext_ior equal to the eta of the
        medium; by default smooth. A rough one takes `translucent_walk` or corrected light.
    reflection: whether the boundary reflects light, by default true.
    thickness: mm; makes the surface a thin wall, see `surface.sheets`.
    priority: where objects or glass overlap, space belongs to the larger one, by default 0. An object that has one, or
        lies inside another in part, has its eta over the index of what is around all of them.

`mitsuba.traverse` shows `albedo`, `sigma_t` (1/mm) and `g` of each channel, textures where they stand for these, and
the parameters of the boundary.
To an integrator that knows nothing of the inside, the surface shows its reflection only. The `albedo` of Mitsuba's
integrator `aov` is the directional albedo of the medium. The index of a smooth boundary is data of kernels, which then
serve media of any index.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import mirrored, opaque
from full_geometry.geometry.snapshot import held
from full_geometry.settings import ORDERS, check_parameters, per_variant, variant_channels
from full_geometry.surface.layered import LayeredMedium, read_layers
from full_geometry.surface.spectral import EVERYWHERE, MediumByWavelength, read_file, spectral_medium
from full_geometry.surface.textured import TexturedMedium, constant_texture, textured_medium
from full_geometry.surface.varying import VaryingMedium, constant_value, mean_of_grids, varying_medium
from halfspace_sss import materials
from halfspace_sss.checks import check_choice, check_flag
from halfspace_sss.materials.catalogue import one_channel
from halfspace_sss.materials.spectra import SpectralMedium
from halfspace_sss.physics.fresnel import F_t, mu_internal
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import directional_table, half_space_reflectance

REFLECTED, REFRACTED = 0, 1  # components


def smooth_boundary(eta: float) -> mi.BSDF:
    """The plain dielectric of a relative index under the current variant of Mitsuba.

    The same events, weights and densities as Mitsuba's `dielectric` without tints, whose index is part of the code of
    every kernel: each other index would compile them all anew.

    Args:
        eta: index inside over index outside.
    """
    props = mi.Properties("smooth_boundary")
    props["eta"] = float(eta)
    return _boundary_class()(props)


def is_smooth_boundary(boundary: mi.BSDF) -> bool:
    """Whether a boundary is one of `smooth_boundary`."""
    return isinstance(boundary, _boundary_class())


@per_variant
def _boundary_class() -> type:

    class SmoothBoundary(mi.BSDF):
        """Reflection by Fresnel's equations, and refraction into the cone by Snell's law."""

        def __init__(self, props: mi.Properties) -> None:
            mi.BSDF.__init__(self, props)
            self.eta = dr.opaque(mi.Float, float(props["eta"]))
            faces = int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
            reflects = int(mi.BSDFFlags.DeltaReflection) | faces
            refracts = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.NonSymmetric) | faces
            self.m_components = [reflects, refracts]
            self.m_flags = reflects | refracts

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("eta", self.eta, mi.ParamFlags.NonDifferentiable)

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            reflects = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, REFLECTED)
            refracts = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, REFRACTED)
            bs, both = dr.zeros(mi.BSDFSample3f), reflects and refracts
            if not (reflects or refracts):
                return bs, mi.Spectrum(0)
            F, cos_t, eta_it, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.eta)
            chosen = u <= F if both else mi.Bool(reflects)
            share = dr.select(chosen, F, 1 - F)
            bs.pdf, weight = (share, mi.Float(1)) if both else (mi.Float(1), share)
            bs.sampled_component = dr.select(chosen, mi.UInt32(REFLECTED), REFRACTED)
            kinds = (mi.UInt32(int(f)) for f in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission))
            bs.sampled_type = dr.select(chosen, *kinds)
            bs.wo = dr.select(chosen, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
            bs.eta = dr.select(chosen, 1, eta_it)
            if ctx.mode == mi.TransportMode.Radiance:  # radiance, unlike importance, grows with the index
                weight = weight * dr.select(chosen, 1, dr.square(eta_ti))
            return bs, mi.Spectrum(dr.select(active, weight, 0))

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            return mi.Spectrum(0)

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            return mi.Float(0)

        def to_string(self) -> str:
            return f"SmoothBoundary[eta = {float(np.max(np.array(self.eta))):.7g}]"

    return SmoothBoundary


DIELECTRICS = ("SmoothDielectric", "RoughDielectric")


def boundary_of(surfaces: list[mi.BSDF], eta: float) -> mi.BSDF:
    """The boundary of a medium from the BSDFs inside a surface: at most one, a dielectric of the same index.

    Raises:
        ValueError: there are several, or it is of another index or kind.
    """
    if len(surfaces) > 1:
        raise ValueError(f"a translucent surface must have at most one BSDF inside, got {len(surfaces)}")
    for boundary in surfaces:
        kind = boundary.class_name()
        if kind not in DIELECTRICS:  # others have an index too: thindielectric, plastic, principled
            raise ValueError(f"the boundary must be a dielectric or roughdielectric, got a {kind}")
        check_eta(boundary, eta)
        if kind != "SmoothDielectric" or mi.traverse(boundary).keys() != {"eta"}:  # rough, or tinted
            return boundary
    return smooth_boundary(eta)


def with_index(boundary: mi.BSDF, eta: float) -> mi.BSDF:
    """A boundary of the same roughness and another relative index, inside over outside; itself if it has that.

    Raises:
        ValueError: the boundary is tinted.
    """
    if abs(index_of(boundary) - eta) < 1e-6 * eta:
        return boundary
    if is_smooth_boundary(boundary):
        return smooth_boundary(eta)
    alpha = {key: value for key, value in held(boundary) if key != "eta"}
    if not alpha.keys() <= {"alpha", "alpha_u", "alpha_v"}:
        raise ValueError(f"the boundary of what overlaps must be without tints, got {', '.join(sorted(alpha))}")
    if abs(eta - 1) < 1e-6:  # which no roughdielectric has
        return smooth_boundary(1.0)
    kind = re.search(r"distribution = (\w+)", str(boundary))[1]
    return mi.load_dict({"type": "roughdielectric", "distribution": kind, "int_ior": eta, "ext_ior": 1.0, **alpha})


def index_of(boundary: mi.BSDF) -> float | None:
    """The relative index of a boundary; None of what has none."""
    eta = mi.traverse(boundary).get("eta")
    return None if eta is None else float(np.max(np.array(eta)))


def check_eta(boundary: mi.BSDF, eta: float) -> None:
    """Refuse a boundary of another index than the medium's."""
    result = index_of(boundary)
    if result is None or abs(result - eta) > 2e-3 * eta:
        raise ValueError(
            f"the boundary must be a dielectric with eta {eta:g} of the medium (int_ior/ext_ior), got {result}"
        )


def is_rough(boundary: mi.BSDF) -> bool:
    """Whether a boundary reflects and refracts over ranges of directions."""
    return bool(boundary.flags() & int(mi.BSDFFlags.Smooth))


def check_boundary(name: str, boundary: mi.BSDF) -> None:
    """Refuse a boundary that models do not know: theirs is smooth and has no colour.

    Args:
        name: of the object, as messages have it.
        boundary: of its medium.
    """
    tints = sorted({key.partition(".")[0] for key in mi.traverse(boundary).keys() if key.startswith("specular_")})
    wrong = [f"without {tint}" for tint in tints] + ["smooth"] * is_rough(boundary)
    if wrong:
        raise ValueError(
            f"the boundary of object {name} must be {wrong[0]} under a model, got a {boundary.class_name()}: the "
            "integrator translucent_walk traces it, and corrected light takes it"
        )


# --------------------------------------------------------------------------------------------------
# The reflection of a dielectric boundary, which is always seen from outside: no path of surfaces leads inside.


class Reflection:
    """The reflecting lobe of a boundary, a BSDF of Mitsuba, whichever way the normals of the object point.
    `lobe`: number of its component that reflects. ValueError if it does not reflect."""

    def __init__(self, boundary: mi.BSDF) -> None:
        lobes = (k for k in range(boundary.component_count()) if boundary.flags(k) & int(mi.BSDFFlags.Reflection))
        self.boundary, self.lobe = boundary, next(lobes, None)
        if self.lobe is None:
            raise ValueError(f"the boundary must reflect, got {boundary}")

    def sample(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """A direction and its weight; one that a smooth boundary reflects to below the surface is reflected again."""
        seen, sign = _from_outside(si)
        bs, weight = self.boundary.sample(self._context(ctx), seen, u, v, active)
        n = si.to_local(si.n)
        n = dr.select(dr.dot(n, si.wi) < 0, -n, n)
        wo = _turned(bs.wo, sign)
        bs.wo = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), mirrored(wo, n), wo)
        bs.sampled_component = 0
        return bs, weight

    def eval(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """Value times cosine."""
        seen, sign = _from_outside(si)
        return self.boundary.eval(self._context(ctx), seen, _turned(wo, sign), active)

    def pdf(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Float:
        seen, sign = _from_outside(si)
        return self.boundary.pdf(self._context(ctx), seen, _turned(wo, sign), active)

    def _context(self, ctx: mi.BSDFContext) -> mi.BSDFContext:
        return mi.BSDFContext(ctx.mode, ctx.type_mask, self.lobe)


def _from_outside(si: mi.SurfaceInteraction3f) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
    """The interaction with the normal on the side that is seen, and 1, or -1 where it was turned."""
    sign = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, mi.Float(-1), 1)
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = _turned(si.wi, sign)
    return seen, sign


def _turned(w: mi.Vector3f, sign: mi.Float) -> mi.Vector3f:
    """A local direction in the frame that is turned about its first axis where the sign is -1."""
    return mi.Vector3f(w.x, w.y * sign, w.z * sign)


VARIABLE = ("albedo", "sigma_t", "g")  # by which light can be differentiated
ALBEDOS, COSINES = 65, 9  # of tables of the directional albedo


def is_translucent(bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF is a `translucent` surface, with a `MediumSpec` as its `spec`."""
    return isinstance(bsdf, translucent_class())


@per_variant
def translucent_class() -> type:
    """The class of the surface for the current variant of Mitsuba."""

    class Translucent(mi.BSDF):
        """The reflection of the boundary as a BSDF; `spec` says what is below.
        `check_model`: raises ValueError for the name of a model that does not exist."""

        def __init__(self, props: mi.Properties, check_model: Callable[[str], None]) -> None:
            mi.BSDF.__init__(self, props)
            check_parameters("translucent", props, (*PARAMETERS, *(key for key, _ in _boundaries(props))))
            self.spec = read_medium_spec(props)
            check_model(self.spec.model)
            self.boundary = boundary_of([inner for _, inner in _boundaries(props)], self.spec.medium.eta)
            self.reflection = Reflection(self.boundary)
            self.m_components = [self.boundary.flags(self.reflection.lobe)]
            self.m_flags = self.m_components[0]
            self.directional: HalfSpaceAlbedo | None = None  # made when it is asked for
            self.asked: list[mi.Frame3f] | None = None  # shading frames of calls, while `surface.wrapped` listens
            for name in VARIABLE:
                setattr(self, name, mi.Spectrum(np.atleast_1d(getattr(self.spec.medium, name)).tolist()))
            self.spec = self.spec.with_variables(self)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            textured = self.spec.textured
            for name, texture in textured.textures.items() if textured else ():
                callback.put(name, texture, mi.ParamFlags.Differentiable)
            for name in self.spec.constants:
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)
            callback.put("boundary", self.boundary, mi.ParamFlags.Differentiable)

        @property
        def volumes(self) -> list[mi.Volume]:
            """The grids of its medium, which no traversal shows."""
            varying = self.spec.varying
            found = () if varying is None or varying.by_depth else (varying.density, varying.albedo_volume)
            return [volume for volume in found if volume is not None]

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            # the integrators see another `spec`, and make anew what they made of it
            repainted = self.spec.textured is not None and not (keys and all(k.startswith("boundary") for k in keys))
            if repainted or (self.spec.constants and self.spec.textured is None):
                values = {name: np.ravel(getattr(self, name)) for name in self.spec.constants}
                self.spec = self.spec.changed(**values).with_variables(self)
            try:
                check_eta(self.boundary, self.spec.medium.eta)
            except ValueError:  # a render after the refusal is of the medium and the boundary before
                boundary = mi.traverse(self.boundary)
                boundary["eta"] = self.spec.medium.eta
                boundary.update()
                raise

        def _shown(self, ctx: mi.BSDFContext, value: mi.Spectrum) -> mi.Spectrum:
            return value if self.spec.reflection and ctx.component in (0, 0xFFFFFFFF) else 0 * value

        def sample(
            self,
            ctx: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            bs, weight = self.reflection.sample(ctx, si, sample1, sample2, active)
            return bs, self._shown(ctx, weight)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Spectrum:
            if self.asked is not None:
                self.asked.append(mi.Frame3f(si.sh_frame))
                return mi.Spectrum(0)
            return self._shown(ctx, self.reflection.eval(ctx, si, wo, active))

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> mi.Float:
            return self._shown(ctx, self.reflection.pdf(ctx, si, wo, active))

        def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            """The directional albedo of the half-space of the medium here, towards the viewer.

            All orders, without what the boundary mirrors: R(mu) of `Medium.reflectance`. The `albedo` of Mitsuba's
            integrator `aov`, which leads denoisers.
            """
            m = self.spec.medium
            if self.directional is None or not self.directional.serves(m):
                self.directional = HalfSpaceAlbedo(m)
            varying, textured, spectral = self.spec.varying, self.spec.textured, self.spec.spectral
            albedo = self.albedo if varying is None else varying.albedo_at(si.p, active)
            albedo = albedo if textured is None else textured.albedo_at(si, active)
            if spectral is not None:
                sigma_t, sigma_s, _ = spectral.at(si.wavelengths)
                albedo = sigma_s / dr.maximum(sigma_t, 1e-30)
            return self.directional(albedo, dr.abs(mi.Frame3f.cos_theta(si.wi))) & active

        def to_string(self) -> str:
            return f"Translucent[{self.spec}, boundary = {self.boundary}]"

    return Translucent


class HalfSpaceAlbedo:
    """R(mu) of half-spaces of any albedo, to 1 % (g up to 0.9), from tables over albedo and internal cosine.

    Args:
        medium: whose g, one for each channel, and eta hold.
    """

    def __init__(self, medium: Medium) -> None:
        self.g, self.eta = np.atleast_1d(medium.g).astype(float).tolist(), float(medium.eta)
        self.steepest = math.sqrt(max(1 - 1 / self.eta**2, 0.0))  # the least internal cosine
        self._tables = {g: self._table(g) for g in set(self.g)}

    def serves(self, medium: Medium) -> bool:
        """Whether another medium differs by nothing but albedo and extinction."""
        return self.g == np.atleast_1d(medium.g).tolist() and self.eta == medium.eta

    def _table(self, g: float) -> mi.Texture2f:
        x, mu_in = np.linspace(0, 1, ALBEDOS), np.linspace(self.steepest, 1, COSINES)
        values = mi.TensorXf(directional_table(g, self.eta, x, mu_in).astype(np.float32)[..., None])
        return mi.Texture2f(values, use_accel=False, wrap_mode=dr.WrapMode.Clamp)

    def __call__(self, albedo: mi.Spectrum, mu: mi.Float) -> mi.Spectrum:
        eta = opaque(self.eta)
        F = F_t(mu, eta)
        u = (mu_internal(mu, eta) - opaque(self.steepest)) * opaque(1 / (1 - self.steepest))
        return mi.Spectrum([F * self._ratio(g, a, u) * a for g, a in zip(self.g, albedo)])

    def _ratio(self, g: float, albedo: mi.Float, u: mi.Float) -> mi.Float:
        """R / (albedo F_t)."""
        c = opaque((1 - max(g, 0.0)) ** (1 / 3))
        s = dr.safe_sqrt((1 - albedo) / (1 - opaque(g) * albedo))
        x = s * c / (1 - (1 - c) * s)
        at = [(v * (n - 1) + 0.5) / n for v, n in ((u, COSINES), (x, ALBEDOS))]
        return dr.exp(self._tables[g].eval(mi.Point2f(*at))[0])


def _boundaries(props: mi.Properties) -> list[tuple[str, mi.BSDF]]:
    return [(key, each) for key, each in props.objects() if isinstance(each, mi.BSDF)]


# --------------------------------------------------------------------------------------------------
# What is below a translucent surface, from the parameters of the plugin: medium, model and scattering orders.


PARAMETERS = (
    "material", "sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "reflectance", "mfp", "g", "eta", "model", "orders",
    "channel", "dilution", "reflection", "spectra", "unit", "priority", "layers",
)  # fmt: skip


@dataclass(frozen=True)
class MediumSpec:
    """The medium below a translucent surface, the model of its light and the orders of scattering that count.

    Args:
        label: name of the material, or of its coefficients.
        medium: with 3 channels under RGB variants, 1/mm; scalar under mono ones.
        model: name of the model.
        orders: "total", "multiple" or "single".
        reflection: whether the boundary reflects.
        varying: how the medium varies in space, a `VaryingMedium`, or None. `medium` then has the means of the grids.
        textured: how it varies over the surface, a `TexturedMedium`, or None; `medium` then has the means of texels.
        spectral: by wavelength, a `MediumByWavelength`, under spectral variants; `medium` then is at four wavelengths.
        priority: where objects overlap, see `walk.priorities`; None where it is not given.
    """

    label: str
    medium: Medium
    model: str
    orders: str
    reflection: bool
    varying: VaryingMedium | None = None
    textured: TexturedMedium | None = None
    spectral: MediumByWavelength | None = None
    priority: float | None = None

    @property
    def is_homogeneous(self) -> bool:
        return self.varying is None and self.textured is None

    @property
    def constants(self) -> tuple[str, ...]:
        """The coefficients of `VARIABLE` that are the same everywhere, which are parameters of the surface."""
        if self.varying is not None or self.spectral is not None:
            return ()
        return VARIABLE if self.textured is None else tuple(n for n in VARIABLE if n in self.textured.constants)

    def channels(self) -> list[Medium]:
        return self.medium.channels()

    def changed(self, **values: np.ndarray) -> MediumSpec:
        """The same with other constants, and with textures as they are now.

        Numbers that are the same in single precision are kept as they are.

        Args:
            values: the `constants`: of `albedo`, `sigma_t` (1/mm) and `g`, one for each channel.

        Raises:
            ValueError: textures are no medium's.
        """
        m, n = self.medium, self.medium.n_channels
        values = {name: np.asarray(value, dtype=float) for name, value in values.items()}
        old = {name: np.atleast_1d(getattr(m, name)) for name in values}
        kept = {name: np.float32(old[name]) == np.float32(value) for name, value in values.items()}
        if self.textured is None and all(same.all() for same in kept.values()):
            return self
        new = {name: np.where(kept[name], old[name], value) for name, value in values.items()}
        if self.textured is not None:
            g = m.g if "g" not in new else new["g"] if n else float(new["g"][0])
            textured = replace(self.textured, **{name: v for name, v in new.items() if name != "g"})
            textured.check()
            return replace(self, medium=textured.mean(g, m.eta), textured=textured)
        if n is None:
            new = {name: float(value[0]) for name, value in new.items()}
        return replace(self, label="medium", medium=Medium.from_albedo(**new, eta=m.eta))

    def with_variables(self, surface: mi.BSDF, **more: mi.Spectrum) -> MediumSpec:
        """The same, with numbers beside textures as the surface has them, for derivatives by them."""
        if self.textured is None:
            return self
        variables = {name: getattr(surface, name) for name in self.constants if name != "g"}
        return replace(self, textured=replace(self.textured, variables=variables | more))


def read_medium_spec(props: mi.Properties) -> MediumSpec:
    """Read the medium, model and orders from the parameters of a surface.

    Raises:
        ValueError: a parameter is missing, unknown in value, or out of range.
    """
    if mi.is_spectral:
        label, medium, spectral = _by_wavelength(props)
        varying, textured = None, None
    else:
        (label, medium, varying, textured), spectral = _medium(props), None
    model, orders = props.get("model", "neural"), props.get("orders", "total")
    check_choice("orders", orders, ORDERS)
    priority, reflection = number_of(props, "priority"), props.get("reflection", True)
    if not math.isfinite(priority or 0.0):
        raise ValueError(f"priority must be finite, got {priority!r}")
    check_flag("reflection", reflection)
    return MediumSpec(
        label=label, medium=medium, model=model, orders=orders, reflection=reflection,
        varying=varying, textured=textured, spectral=spectral, priority=priority,
    )  # fmt: skip


COEFFICIENTS = ("sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "reflectance", "mfp", "g", "eta")


def _by_wavelength(props: mi.Properties) -> tuple[str, Medium, MediumByWavelength]:
    """Read the medium under a spectral variant: its label, the medium at four wavelengths, and at all."""
    for key in ("material", "dilution", "channel", "layers"):
        if key in props:
            raise ValueError(
                f"{key} must be left out under a spectral variant, as the channels of materials are no spectra, got "
                f"{props[key]!r}: give spectra"
            )
    values, wavelengths = spectral_medium(props, COEFFICIENTS)
    if "spectra" in props:
        if values:
            raise ValueError(f"spectra must stand without {', '.join(values)}, got both")
        spectral = MediumByWavelength.of(read_file(props))
        return str(props["spectra"]), spectral.mean(), spectral
    if not any(values.keys() >= set(pair) for pair in PAIRS):
        raise ValueError(
            "a translucent surface must have spectra, or sigma_s and sigma_a, or sigma_t and albedo, or reflectance "
            "and mfp under a spectral variant"
        )
    if np.ndim(values.get("eta", 1.0)):
        raise ValueError("eta must be a number under a spectral variant, got a spectrum: dispersion is left out")
    if wavelengths is not None and "reflectance" in values:
        values["reflectance"] = _clipped(values)
    medium, _, _ = _inline_medium(values)
    wavelengths = EVERYWHERE if wavelengths is None else wavelengths
    by_wavelength = _of_channels(medium, len(wavelengths))
    coefficients = (by_wavelength.sigma_s, by_wavelength.sigma_a, by_wavelength.g, medium.eta)
    spectral = MediumByWavelength.of(SpectralMedium(wavelengths, *coefficients))
    return "medium", spectral.mean(), spectral


def _clipped(values: dict[str, Any]) -> np.ndarray:
    """Reflectance by wavelength, which a colour may make more than any medium has, at what that has; warns of it."""
    g, R = np.broadcast_arrays(values.get("g", 0.0), values["reflectance"])
    most = {each: half_space_reflectance(1.0, each, float(values.get("eta", ETA))) for each in set(g.tolist())}
    most = np.array([most[each] for each in g.tolist()])
    above = int((most * (1 + 1e-6) < R).sum())
    if above:
        warnings.warn(
            f"{above} of {len(R)} wavelengths of reflectance are above {most.min():.4g}, the reflectance without "
            "absorption, and are clipped",
            stacklevel=2,
        )
    return np.minimum(R, most)


def _medium(props: mi.Properties) -> tuple[str, Medium, VaryingMedium | None, TexturedMedium | None]:
    for key in ("spectra", "unit"):
        if key in props:
            raise ValueError(f"{key} must be left out but under a spectral variant, got {props[key]!r}")
    inline = {key: constant_texture(constant_value(props[key])) for key in COEFFICIENTS if key in props}
    if "layers" in props:
        if others := [*inline, *(key for key in ("material", "dilution") if key in props)]:
            raise ValueError(f"layers must stand without {', '.join(others)}, got both")
        media, thickness = read_layers(str(props["layers"]))
        layered = LayeredMedium.of(tuple(_for_variant("layers", m, None, props)[1] for m in media), thickness)
        return str(props["layers"]), layered.mean(), layered, None
    if "material" in props:
        if inline:
            raise ValueError(f"material must stand without {', '.join(inline)}, got both")
        material = materials.load(props["material"], dilution=number_of(props, "dilution"))
        label, medium, names = material.name, material.medium, material.channels
    elif "dilution" in props:
        raise ValueError(f"dilution must be left out without material, got {props['dilution']!r}")
    elif any(inline.keys() >= set(pair) for pair in PAIRS):
        label, names = "medium", None
        medium, varying, textured = _inline_medium(inline)
        if not (varying is None and textured is None):
            return label, medium, varying, textured
    else:
        raise ValueError(
            "a translucent surface must have material, or sigma_s and sigma_a, or sigma_t and albedo, or reflectance "
            "and mfp"
        )
    return *_for_variant(label, medium, names, props), None, None


IN_SPACE, OVER_SURFACE = ("sigma_t", "scale", "albedo"), ("albedo", "sigma_t", "reflectance", "mfp")
ETA = 1.3  # where none is given
PAIRS = (("sigma_s", "sigma_a"), ("sigma_t", "albedo"), ("reflectance", "mfp"))


def _inline_medium(inline: dict[str, Any]) -> tuple[Medium, VaryingMedium | None, TexturedMedium | None]:
    """The medium of coefficients, and how it varies in space or over the surface if it does."""
    values = {k: v if isinstance(v, (mi.Volume, mi.Texture)) else _numbers(k, v) for k, v in inline.items()}
    volumes = [key for key, value in values.items() if isinstance(value, mi.Volume)]
    textures = [key for key, value in values.items() if isinstance(value, mi.Texture)]
    for keys, kind, able in ((volumes, "volume", IN_SPACE), (textures, "texture", OVER_SURFACE)):
        for key in keys:
            if key not in able:
                raise ValueError(f"{key} must be constant, got a {kind}; {', '.join(able)} may vary")
    if volumes and textures:
        raise ValueError(f"{textures[0]} must be a number where {volumes[0]} is a volume, got a texture")
    etas, g = np.unique(values.pop("eta", ETA)), values.pop("g", 0.0)
    if len(etas) > 1:
        raise ValueError(f"eta must be one number for all channels, got {etas.tolist()}: dispersion is left out")
    eta = float(etas[0])
    pair = next(pair for pair in PAIRS if values.keys() >= set(pair))
    if extra := values.keys() - set(pair) - ({"scale"} if "albedo" in pair else set()):
        raise ValueError(f"{' and '.join(pair)} must stand without {', '.join(sorted(extra))}, got both")
    if textures:
        textured = textured_medium(values, g, eta, variant_channels())
        return textured.mean(g, eta), None, textured
    if "sigma_s" in pair:
        return Medium(**values, g=g, eta=eta), None, None
    if "mfp" in pair:
        return Medium.from_reflectance(**values, g=g, eta=eta), None, None
    scale = values.get("scale", 1.0)
    if not volumes:
        return Medium.from_albedo(values["albedo"], np.asarray(values["sigma_t"]) * scale, g, eta), None, None
    varying = varying_medium(values["sigma_t"], values["albedo"], scale, variant_channels())
    return mean_of_grids(varying, g, eta), varying, None


def _for_variant(label: str, medium: Medium, names: Sequence[str] | None, props: mi.Properties) -> tuple[str, Medium]:
    n, wanted = medium.n_channels, variant_channels()
    channel = props["channel"] if "channel" in props else None
    if wanted == 1 and n is not None:
        if channel is None:
            raise ValueError(f"channel must be given under a mono variant, got none for {label} with {n} channels")
        by_name = {name.casefold(): k for k, name in enumerate(names or ())}
        return f"{label} {channel}", one_channel(medium, by_name.get(str(channel).casefold(), channel))[1]
    if channel is not None:
        raise ValueError(f"channel must be left out under this variant or for this medium, got {channel!r}")
    if wanted == 3 and n is None:
        return label, _of_channels(medium, 3)
    if wanted == 3 and n != 3:
        raise ValueError(f"medium must have 1 or 3 channels, got {n}")
    return label, medium


def _of_channels(medium: Medium, n: int) -> Medium:
    """A medium of n channels, the same in all if it has none."""
    same = {key: np.broadcast_to(getattr(medium, key), n).astype(float) for key in ("sigma_s", "sigma_a", "g")}
    return Medium(**same, eta=medium.eta)


def number_of(props: mi.Properties, key: str) -> float | None:
    """A parameter that is one number; None if there is none."""
    try:
        return float(props[key]) if key in props else None
    except (TypeError, ValueError):
        raise ValueError(f"{key} must be a number, got {props[key]!r}") from None


def _numbers(key: str, value: Any) -> Any:
    """A number, or one per channel, from a parameter."""
    try:
        parts = value.split(",") if isinstance(value, str) else np.ravel(np.array(value, dtype=float)).tolist()
        result = np.array([float(part) for part in parts])
    except (TypeError, ValueError):
        got = f"a {value.class_name().partition('Impl')[0]}" if isinstance(value, mi.Object) else repr(value)
        raise ValueError(f"{key} must be a number, rgb, or numbers separated by commas, got {got}") from None
    return float(result[0]) if len(result) == 1 else result
