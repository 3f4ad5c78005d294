"""Media by textures of the surface: what they are, what the walk and models take of them, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_translucent_walk import WIDEST_Z_OF_RUNS, _lamp, _runs, _scene, _small_lamp, _z

from full_geometry.geometry.points import SurfacePoint
from full_geometry.geometry.shape import analyse_shape
from full_geometry.settings import Settings
from full_geometry.surface.textured import _interaction
from full_geometry.transport.palette import Distances
from full_geometry.transport.prepare import make_objects
from halfspace_sss import Medium, bssrdf, measure
from halfspace_sss.neural import material_model, paper_model, store

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

PLAIN = {"sigma_t": "0.5,1.25,2.5", "albedo": "0.9375,0.875,0.75", "g": 0.5, "eta": 1.4}
OTHER = {**PLAIN, "sigma_t": "1.5,0.75,0.5", "albedo": "0.25,0.5,0.875"}


def _bitmap(values: Any, **more: Any) -> dict:
    """Rows of texels, shape (rows, columns, channels)."""
    data = np.ascontiguousarray(values, dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest", **more}


def _texels(*colours: str) -> dict:
    """One row, each texel as wide as the others."""
    return _bitmap([[[float(x) for x in colour.split(",")] for colour in colours]])


def _painted(*surfaces: dict) -> dict:
    """Surfaces side by side about the axis of a sphere: of two, the first has y > 0."""
    textures = {key: _texels(*(surface[key] for surface in surfaces)) for key in ("sigma_t", "albedo")}
    return {**surfaces[0], **textures}


@pytest.mark.parametrize("light", [_lamp, _small_lamp], ids=["lamp", "small"])
def test_a_constant_texture_is_a_constant(light: Any) -> None:
    """To rounding: kernels differ, as walks carry their medium."""
    images = [mi.render(mi.load_dict(_scene(s, light())), spp=64, seed=1).numpy() for s in (PLAIN, _painted(PLAIN))]
    np.testing.assert_allclose(images[1], images[0], atol=2e-6 * images[0].max())


def test_a_walk_keeps_the_medium_of_its_exit() -> None:
    """Each half of a sphere looks as a sphere all of its medium does."""
    painted, first, second = (
        _runs(mi.load_dict(_scene(s, _small_lamp())), 12, 64, seed)
        for s, seed in ((_painted(PLAIN, OTHER), 1), (PLAIN, 100), (OTHER, 200))
    )
    assert np.abs(_z(painted, np.concatenate([first[:, :4], second[:, 4:]], axis=1))).max() < WIDEST_Z_OF_RUNS
    assert np.abs(_z(painted, second)).max() > WIDEST_Z_OF_RUNS  # which is seen


def test_a_white_texture_without_absorption_is_invisible_in_uniform_light() -> None:
    surface = {"reflectance": _bitmap(np.ones((2, 2, 3))), "mfp": 0.4, "eta": 1.5}
    with pytest.warns(UserWarning, match="4 of 4 texels of reflectance are above"):
        image = mi.render(mi.load_dict(_scene(surface)), spp=16, seed=1).numpy()
    np.testing.assert_allclose(image, 1, rtol=1e-5)


def test_a_white_texture_sends_the_energy_of_the_model() -> None:
    """To 0.5 %: along the normal under even light F_r(1) + R(1) of the half-space, as these models are reciprocal.

    Half of the texels absorb as little as float32 has it, so that the texture is one: 0.2 % by the exact reflectance.
    """
    half, at = 400.0, mi.ScalarTransform4f()
    view = at.look_at([0, 0, 2 * half], [0, 0, 0], [0, 1, 0]) @ at.scale([0.25 * half, 0.25 * half, 1])
    white = {
        "albedo": _texels("1,1,1", "0.9999999,0.9999999,0.9999999"),
        "sigma_t": 1.0,
        "eta": 1.4,
        "model": "better_dipole",
    }
    scene = {
        "type": "scene",
        "integrator": {"type": "bssrdf"},
        "sensor": {"type": "orthographic", "to_world": view, "film": {"type": "hdrfilm", "width": 32, "height": 32}},
        "sky": {"type": "constant", "radiance": 1.0},
        "block": {"type": "cube", "to_world": at.scale(half), "bsdf": {"type": "translucent", **white}},
    }
    image = mi.render(mi.load_dict(scene), spp=256, seed=1).numpy()
    media = [Medium.from_albedo(albedo, 1.0, 0.0, 1.4) for albedo in (1.0, float(np.float32(0.9999999)))]
    assert 1 - media[1].reflectance(1.0) / media[0].reflectance(1.0) < 2e-3
    own = np.mean([measure.reflectance(bssrdf("better_dipole", m), 1.0, "total") for m in media])
    assert image.mean() == pytest.approx(float(own) + (0.4 / 2.4) ** 2, rel=5e-3)


TAKING = [
    *("standard_dipole", "better_dipole", "directional_dipole", "normalized_diffusion", "lambert"),
    pytest.param("forward_scattering_dipole", marks=pytest.mark.slow),
    pytest.param("photon_beam_diffusion", marks=pytest.mark.slow),
    pytest.param("neural", marks=pytest.mark.slow),
]


def _transports(name: str, *surfaces: dict) -> list[Any]:
    objects = [
        make_objects(mi.load_dict(_scene({**surface, "model": name}, mm_per_unit=0.5)), Settings())[0]
        for surface in surfaces
    ]
    return objects


def _S(obj: Any, seed: int = 1, n: int = 512) -> np.ndarray:
    """S between random points at most a few mean free paths apart, channels last."""
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(3, n))
    p, far = p / np.linalg.norm(p, axis=0), 10.0
    q = p + rng.normal(size=(3, n)) * rng.uniform(0.01, 0.2, n)
    q /= np.linalg.norm(q, axis=0)
    ends = []
    for x in (p, q):
        w = mi.Vector3f(dr.normalize(mi.Vector3f(x + 0.3 * rng.normal(size=(3, n)))))
        medium = () if obj.textured is None else obj.textured.at_point(
            obj.geometry, mi.Point3f(far * x), mi.Normal3f(x), mi.UInt32(0))  # fmt: skip
        ends.append(SurfacePoint(mi.Point3f(far * x), mi.Normal3f(x), mi.Normal3f(x), w, medium=medium))
    return np.array(obj.transport.S(obj.transport.prepare(ends[0]), ends[1])).T


@pytest.mark.parametrize("model", TAKING)
def test_models_of_one_texel_are_those_of_its_medium(model: str) -> None:
    """To the last bit; of albedo 1: a white texture has the energy of the model."""
    white = {**PLAIN, "albedo": "1,1,1"}
    plain, painted = (_S(obj) for obj in _transports(model, white, _painted(white)))
    assert np.array_equal(painted, plain)


@pytest.mark.parametrize("model", ["better_dipole", pytest.param("neural", marks=pytest.mark.slow)])
def test_models_between_nodes_are_those_of_the_medium(model: str) -> None:
    """With other texels beside, to 0.5 %, by reduced networks to 2.5 %: ln S is nearly linear in v."""
    medium = {**PLAIN, "albedo": "0.96,0.83,0.65"}
    beside = {**PLAIN, "albedo": "0.3,0.99,0.999", "sigma_t": "3,2,1"}
    (plain, painted) = _transports(model, medium, _painted(medium, beside))
    a, b = _S(plain), _S(painted)
    upper = np.random.default_rng(1).normal(size=(3, 512))[1] > 0.5  # both ends are in the first texel
    assert np.abs(a - b)[upper].sum() < (0.025 if model == "neural" else 0.005) * a[upper].sum()
    assert np.abs(a - b).sum() > 0.05 * a.sum()


@pytest.mark.parametrize(
    ("model", "error"), [("better_dipole", 5e-3), pytest.param("neural", 0.15, marks=pytest.mark.slow)]
)
def test_S_is_the_geometric_mean_of_both_ends(model: str, error: float) -> None:
    """And so reciprocal; by reduced networks single values to 15 %, their sum to 2 %."""
    first, second, painted = _transports(model, PLAIN, OTHER, _painted(PLAIN, OTHER))
    a, b, c = (_S(obj) for obj in (first, second, painted))
    rng = np.random.default_rng(1)
    p = rng.normal(size=(3, 512))
    q = p / np.linalg.norm(p, axis=0) + rng.normal(size=(3, 512)) * rng.uniform(0.01, 0.2, 512)
    across = p[1] * q[1] < 0
    assert 10 < across.sum() < 200
    wanted = np.where(across[:, None], np.sqrt(a * b), np.where((p[1] > 0)[:, None], a, b))
    np.testing.assert_allclose(c, wanted, rtol=error, atol=1e-5 * wanted.max())
    np.testing.assert_allclose(c[across].sum(axis=0), wanted[across].sum(axis=0), rtol=min(error, 0.02))


@pytest.mark.parametrize("count", [0, 3])
def test_networks_are_asked_at_all_distances_or_between_few(count: int) -> None:
    """Between three, functions quadratic in the logarithm are exact, of distances that are the same too."""
    every = [mi.Float(0.1, 2), mi.Float(0.3, 2), mi.Float(0.7, 2)]
    distances = Distances.of(every, count)
    values = [[dr.square(dr.log(r)), dr.log(r)] for r in distances.r]
    for k, r in enumerate(every):
        square, linear = distances.interpolated(values, k, r)
        np.testing.assert_allclose(square, np.log(r) ** 2, atol=1e-5)
        np.testing.assert_allclose(linear, np.log(r), atol=1e-5)


@pytest.mark.slow
def test_a_model_of_a_constant_texture_renders_as_of_a_constant() -> None:
    """The same bits; and derivatives by its texels are known after an image without them."""
    images = []
    for surface in (PLAIN, _painted(PLAIN)):
        description = _scene({**surface, "model": "better_dipole"}, _small_lamp())
        description["integrator"] = {"type": "bssrdf", "mm_per_unit": 0.8}
        scene = mi.load_dict(description)
        images.append(mi.render(scene, spp=64, seed=1).numpy())
    assert np.array_equal(images[1], images[0])
    parameters = mi.traverse(scene)
    texels = parameters["object.bsdf.albedo.data"]
    dr.enable_grad(texels)
    parameters["object.bsdf.albedo.data"] = texels
    parameters.update()
    dr.backward(dr.mean(mi.render(scene, parameters, spp=4, seed=1)))
    assert (np.array(dr.grad(texels))[0] > 0).all()  # the lit half


@pytest.mark.parametrize(
    ("model", "integrator", "message"),
    [
        ("neural_shape", {}, "must be without textures for the model 'neural_shape'"),
    ],
)
def test_what_takes_no_textures_refuses_them_by_name(model: str, integrator: dict, message: str) -> None:
    scene = _scene({**_painted(PLAIN, OTHER), "model": model})
    scene["integrator"] = {"type": "bssrdf", **integrator}
    with pytest.raises(ValueError, match=message):
        mi.render(mi.load_dict(scene), spp=1)


@pytest.mark.parametrize("module", [material_model, paper_model], ids=["neural_material", "neural_paper"])
def test_models_of_one_medium_refuse_textures_by_name(
    module: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(module, "find_weights", store.find_weights)
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", str(tmp_path))
    scene = _scene({**_painted(PLAIN, OTHER), "model": module.KIND})
    scene["integrator"] = {"type": "bssrdf"}
    with pytest.raises(ValueError, match=f"^model '{module.KIND}' must be one of any medium for media by textures: "):
        mi.render(mi.load_dict(scene), spp=1)


def test_the_albedo_of_aovs_is_that_of_the_texels() -> None:
    surface = mi.load_dict({"type": "translucent", **_painted(PLAIN, OTHER)})
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.uv, si.wi = mi.Point2f([0.2, 0.7], 0.5), mi.Vector3f(0.6, 0, 0.8)
    found = np.array(surface.eval_diffuse_reflectance(si)).T
    albedos = [[float(x) for x in s["albedo"].split(",")] for s in (PLAIN, OTHER)]
    wanted = [
        Medium.from_albedo(np.array(albedo), 1.0, PLAIN["g"], PLAIN["eta"]).reflectance(0.8) for albedo in albedos
    ]
    np.testing.assert_allclose(found, wanted, rtol=2e-3)


@pytest.mark.parametrize("unit", [1.0, 1e-8, 1e8])
def test_points_of_a_mesh_have_their_uv_in_any_unit_of_length(unit: float) -> None:
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(unit)})
    ray = mi.Ray3f(mi.Point3f([0.2 * unit, -0.7 * unit], 0.1 * unit, 3 * unit), mi.Vector3f(0, 0, -1))
    si = mi.load_dict({"type": "scene", "cube": cube}).ray_intersect(ray)
    found = _interaction(analyse_shape(cube), si.p, si.n, si.prim_index, mi.Bool(True))
    np.testing.assert_allclose(found.uv, si.uv, atol=1e-5)


def test_texels_that_change_are_as_in_a_fresh_scene() -> None:
    scene, fresh = (mi.load_dict(_scene(_painted(s, PLAIN), _lamp())) for s in (OTHER, PLAIN))
    mi.render(scene, spp=1)
    parameters, wanted = mi.traverse(scene), mi.traverse(fresh)
    for key in ("object.bsdf.albedo.data", "object.bsdf.sigma_t.data"):
        parameters[key] = wanted[key]
    parameters.update()
    assert np.array_equal(*(mi.render(s, spp=16, seed=2).numpy() for s in (scene, fresh)))
    parameters["object.bsdf.albedo.data"] = mi.TensorXf(np.full((1, 2, 3), np.nan, dtype=np.float32))
    with pytest.raises(ValueError, match="albedo must be in .0, 1., got nan"):
        parameters.update()


def _mesh(color: np.ndarray | None = None, **more: Any) -> Any:
    """A tetrahedron without uv, with an attribute of its vertices."""
    mesh = mi.Mesh("tetrahedron", 4, 4, **more)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float([0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9])
    parameters["faces"] = mi.UInt32([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3])
    parameters.update()
    if color is not None:
        mesh.add_attribute("vertex_color", color.size // 4, color.ravel().tolist())
    return mesh


def _on_mesh(surface: dict, color: np.ndarray | None = None) -> None:
    """Asks for an image of it."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "translucent", **surface})
    scene = _scene(PLAIN)
    scene["object"] = _mesh(color, props=props)
    mi.render(mi.load_dict(scene), spp=1)


def test_reflectance_becomes_the_medium_of_that_reflectance() -> None:
    """Of each channel, to 2e-5, over the whole range."""
    colours = np.random.default_rng(3).uniform(0, 0.9, (1, 32, 3))
    colours[0, :2] = [[0, 1e-3, 1], [0.02, 0.5, 0.98]]
    colours *= Medium.from_albedo(1.0, 1.0, 0.6, 1.4).reflectance()
    surface = {"reflectance": _bitmap(colours), "mfp": _bitmap(np.full((1, 1, 3), [0.2, 4.0, 50.0])), "g": 0.6}
    textured = mi.load_dict({"type": "translucent", **surface, "eta": 1.4}).spec.textured
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f((np.arange(32) + 0.5) / 32, 0.5)
    at = textured.at(si)
    albedo, sigma_t = np.array(at.albedo).T, np.array(at.sigma_t).T
    wanted = Medium.from_reflectance(colours[0].ravel(), 1.0, 0.6, 1.4).albedo
    np.testing.assert_allclose(albedo.ravel(), wanted, atol=2e-5)
    np.testing.assert_allclose(sigma_t, np.broadcast_to([5, 0.25, 0.02], (32, 3)), rtol=1e-6)


def test_colours_that_no_medium_has_are_clipped_with_one_warning() -> None:
    colours = np.full((4, 5, 3), 0.3)
    colours[1, :3, 0] = 0.99
    with pytest.warns(UserWarning, match="3 of 20 texels of reflectance are above 0.93") as caught:
        surface = mi.load_dict({"type": "translucent", "reflectance": _bitmap(colours), "mfp": 1.0})
    assert len(caught) == 1
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f(0.1, 0.3)
    assert np.ravel(np.array(surface.spec.textured.at(si).albedo))[0] == 1


def test_a_number_of_reflectance_is_the_medium_that_has_it() -> None:
    inside = mi.load_dict({"type": "translucent", "reflectance": "0.8,0.5,0.2", "mfp": 2.0, "g": 0.5}).spec
    assert inside.medium == Medium.from_reflectance(np.array([0.8, 0.5, 0.2]), 2.0, 0.5, 1.3)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"albedo": np.full((1, 1, 3), np.nan)}, r"albedo must be in \[0, 1\], got nan"),
        ({"albedo": np.full((1, 2, 3), 1.5)}, r"albedo must be in \[0, 1\], got 1.5"),
        ({"albedo": np.full((1, 2, 1), -0.5)}, r"albedo must be in \[0, 1\], got -0.5"),
        ({"sigma_t": np.zeros((1, 2, 3))}, r"sigma_t must be finite and > 0 \(1/mm\), got 0.0"),
        ({"sigma_t": np.ones((1, 1, 3)), "scale": -1.0}, "scale must be finite and > 0, got -1.0"),
        ({"albedo": np.full((1, 1, 3), 0.5), "sigma_t": "1,2"}, r"sigma_t must be a number or one per channel \(3\)"),
        ({"g": np.full((1, 1, 3), 0.5)}, "g must be constant, got a texture; albedo, sigma_t, reflectance, mfp may"),
    ],
)
def test_textures_that_are_no_media_are_refused(changed: dict, message: str) -> None:
    textures = {key: _bitmap(value) if isinstance(value, np.ndarray) else value for key, value in changed.items()}
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "translucent", **PLAIN, **textures})


@pytest.mark.parametrize(
    ("texture", "color", "message"),
    [
        (None, None, "object 'object' must have uv for the texture albedo, got a mesh without"),
        ("vertex_color", None, "must have the attribute 'vertex_color' of the texture albedo"),
        ("vertex_color", np.full((4, 2), 0.5), "'vertex_color' of the texture albedo must have 1 or 3 values, got 2"),
        ("vertex_color", np.full((4, 3), 1.5), r"albedo must be in \[0, 1\], got 1.5"),
    ],
)
def test_textures_without_a_place_on_a_mesh_are_refused(texture: str | None, color: Any, message: str) -> None:
    albedo = _texels(PLAIN["albedo"]) if texture is None else {"type": "mesh_attribute", "name": texture}
    with pytest.raises(ValueError, match=message):
        _on_mesh({**PLAIN, "albedo": albedo}, color)


@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_uv_at_a_point_of_a_face_is_that_of_a_ray_there(shape: str) -> None:
    texels = np.random.default_rng(2).uniform(0.1, 0.9, (8, 8, 3))
    surface = {**PLAIN, "albedo": _bitmap(texels, filter_type="bilinear")}
    form = {"type": shape, "to_world": mi.ScalarTransform4f().scale(5).rotate([0.6, 0.8, 0], 30)}
    obj = make_objects(mi.load_dict(_scene({**surface, "model": "lambert"}, shape=form)), Settings())[0]
    o = np.random.default_rng(3).normal(size=(3, 64))
    o /= np.linalg.norm(o, axis=0)
    si = obj.geometry.scene.ray_intersect(mi.Ray3f(mi.Point3f(20 * o), mi.Vector3f(-o)))
    found = obj.textured.at_point(obj.geometry, si.p, si.n, si.prim_index).albedo
    np.testing.assert_allclose(np.array(found), np.array(obj.textured.at(si).albedo), atol=1e-4)
