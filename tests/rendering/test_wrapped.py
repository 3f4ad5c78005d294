"""What scenes put around a translucent surface: twosided, normal and bump maps, masks and blends."""

from __future__ import annotations

import re

import numpy as np
import pytest
from rendered import direction, independent, surface
from scipy import stats

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

LAMP = {"type": "sphere", "center": [12, 3, 12], "radius": 3.0, "emitter": {"type": "area", "radiance": 10.0}}
BALL = {"type": "sphere", "radius": 4.0}
PASSES, SPP = 5, 96  # Student's t of 8 degrees of freedom
PLAIN = {**surface("better_dipole", "total"), "reflection": True}
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
INTEGRATORS = ["bssrdf", "translucent_walk"]


def bitmap(values: list) -> dict:
    """A texture of given texels, rows of pixels."""
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.array(values, dtype=np.float32))}


def images(bsdf: dict | None, integrator: str, seed: int = 1, shape: dict = BALL, **lights: dict) -> np.ndarray:
    """Independent images of an object, stacked first."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at((30 * direction(20)).tolist(), [0, 0, 0], [0, 1, 0])
    sampled = {"light": "sampled"} if integrator == "translucent_walk" else {}  # as behind masks and maps
    scene = {"type": "scene", "integrator": {"type": integrator, **sampled},
             **(lights or {"lamp": LAMP, "sky": {"type": "constant", "radiance": 0.2}}),
             "sensor": {"type": "perspective", "fov": 18.0, "to_world": at, "film": film},
             **({"object": {**shape, "bsdf": bsdf}} if bsdf else {})}  # fmt: skip
    scene = mi.load_dict(scene)
    return independent(scene, PASSES, SPP, 100 * seed)


def same(a: np.ndarray, b: np.ndarray) -> None:
    """z-tests of the means of the images, per channel, and of all pixels, at a significance of 1e-4 each."""
    p = stats.ttest_ind(a.mean(axis=(1, 2)), b.mean(axis=(1, 2))).pvalue
    assert p.min() * p.size > 1e-4, (a.mean(axis=(0, 1, 2)), b.mean(axis=(0, 1, 2)))
    noisy = np.concatenate([a, b]).std(axis=0) > 1e-6
    assert np.allclose(a.mean(axis=0)[~noisy], b.mean(axis=0)[~noisy], atol=1e-5)
    # pixels that few samples find the object in have no normal distribution
    often = np.min([np.median(np.abs(x - np.median(x, axis=0)), axis=0) for x in (a, b)], axis=0) > 1e-4 * a.mean()
    p = stats.ttest_ind(a[:, often], b[:, often]).pvalue
    assert often.mean() > 0.5 and p.min() * p.size > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_wrappers_without_content_change_nothing(integrator):
    plain = images(PLAIN, integrator)
    twosided = images({"type": "twosided", "of": PLAIN}, integrator)
    assert np.array_equal(twosided, plain)
    flat = images({"type": "normalmap", "normalmap": bitmap([[[0.5, 0.5, 1.0]]]), "of": PLAIN}, integrator, 2)
    same(flat, plain)
    masked = {"type": "mask", "opacity": 1.0, "of": {"type": "bumpmap", "map": bitmap([[[0.3]]]), "of": PLAIN}}
    same(images({"type": "blendbsdf", "weight": 0.0, "a": masked, "b": RED}, integrator, 3), plain)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_blend_is_the_mean_by_its_weight(integrator):
    blend = images({"type": "blendbsdf", "weight": 0.3, "a": PLAIN, "b": RED}, integrator)
    other = images(
        {"type": "blendbsdf", "weight": 0.7, "a": RED, "b": {"type": "twosided", "of": PLAIN}}, integrator, 2
    )
    mean = 0.7 * images(PLAIN, integrator, 3) + 0.3 * images(RED, "path", 4)
    same(blend, mean)
    same(other, mean)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_mask_shows_its_share_of_what_is_behind(integrator):
    masked = images({"type": "mask", "opacity": 0.25, "of": PLAIN}, integrator)
    same(masked, 0.25 * images(PLAIN, integrator, 2) + 0.75 * images(None, "path", 3))


TILT = np.radians(25.0)
SIDE = 40.0


def slab(folder, slope: float) -> dict:
    """A closed box larger than what the camera sees, uv in units of its side, all normals of its top of one slope."""
    corners = [(-SIDE, -SIDE), (SIDE, -SIDE), (SIDE, SIDE), (-SIDE, SIDE)]
    lines = [f"v {x} {y} {z}" for z in (-20.0, 0.0) for x, y in corners]
    lines += [f"vt {x / (2 * SIDE) + 0.5} {y / (2 * SIDE) + 0.5}" for x, y in corners]
    top = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1)
    normals = [top, [0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    lines += ["vn {} {} {}".format(*n) for n in normals]
    sides = [(5, 6, 7, 8), (4, 3, 2, 1), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)]
    for n, (a, b, c, d) in enumerate(sides, 1):
        lines += [f"f {a}/1/{n} {b}/2/{n} {c}/3/{n}", f"f {a}/1/{n} {c}/3/{n} {d}/4/{n}"]
    path = folder / f"slab_{slope:.3f}.obj"
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path)}


@pytest.mark.parametrize(("kind", "integrator"), [("normalmap", "translucent_walk"), ("bumpmap", "bssrdf")])
def test_a_map_of_one_slope_is_a_mesh_with_such_normals(integrator, kind, tmp_path):
    slope = float(np.tan(TILT))
    if kind == "normalmap":
        around = {"type": kind, "normalmap": bitmap([[[0.5 - 0.5 * np.sin(TILT), 0.5, 0.5 + 0.5 * np.cos(TILT)]]])}
    else:  # the height, by u
        ramp = (np.arange(8) + 0.5) / 8 * slope * 2 * SIDE
        around = {"type": kind, "map": {**bitmap([ramp[:, None].tolist()]), "wrap_mode": "clamp"}}
    flat, lamp = slab(tmp_path, 0.0), {"lamp": {**LAMP, "center": [-12, 3, 20]}}
    bent = images({**around, "of": PLAIN}, integrator, 1, flat, **lamp)
    same(bent, images(PLAIN, integrator, 2, slab(tmp_path, slope), **lamp))
    p = stats.ttest_ind(bent.mean(axis=(1, 2, 3)), images(PLAIN, integrator, 3, flat, **lamp).mean(axis=(1, 2, 3)))
    assert p.pvalue < 1e-4


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_furnace_stays_even_behind_a_rough_normal_map_and_a_mask(integrator):
    n = np.random.default_rng(3).normal([0, 0, 1], 0.5, (8, 8, 3))
    rough = bitmap(0.5 * n / np.linalg.norm(n, axis=2, keepdims=True) + 0.5)
    white = {**PLAIN, "sigma_s": 1.0, "sigma_a": 0.0}
    bsdf = {"type": "mask", "opacity": 0.7, "of": {"type": "normalmap", "normalmap": rough, "of": white}}
    image = images(bsdf, integrator, sky={"type": "constant"})
    means = image.mean(axis=(1, 2, 3))
    if integrator == "translucent_walk":  # a significance of 1e-4
        assert np.abs(means - 1).max() < 1e-6 or stats.ttest_1samp(means, 1.0).pvalue > 1e-4
    assert image.mean(axis=(0, 3)).max() < 1.02
    plain = images(white, integrator, 2, sky={"type": "constant"}).mean()
    assert means.mean() == pytest.approx(0.7 * plain + 0.3, abs=0.02)


def _flat(inner: dict) -> dict:
    return {"type": "normalmap", "normalmap": bitmap([[[0.5, 0.5, 1.0]]]), "of": inner}


def _blend(a: dict, b: dict) -> dict:
    return {"type": "blendbsdf", "weight": 0.5, "a": a, "b": b}


REFUSED = {
    "two sides": (lambda: {"type": "twosided", "a": PLAIN, "b": RED}, {}, "twosided of 'object' must have one BSDF"),
    "two maps": (lambda: _flat(_flat(PLAIN)), {}, "must have one normalmap or bumpmap, got two at 'object'"),
    "two media": (lambda: _blend(PLAIN, PLAIN), {}, "blendbsdf of 'object' must be .*, got two translucent ones"),
    "glass": (lambda: _blend(PLAIN, {"type": "dielectric"}), {}, "got one with the SmoothDielectric, which lets light"),
    "blend in a map": (lambda: _flat(_blend(PLAIN, RED)), {}, "with maps inside, got one inside normalmap"),
    "learnt": (lambda: _flat({**PLAIN, "model": "neural_shape"}), {}, "'object' must be without normal and bump maps"),
    "no slopes": (
        lambda: {"type": "bumpmap", "map": {"type": "checkerboard"}, "of": PLAIN},
        {},
        "bumpmap of object 'object' must be a texture with slopes, such as a bitmap, got .*not implemented",
    ),
    "gathered": (lambda: _flat(PLAIN), {"light": "gathered"}, "'object', which has a normal or bump map, got gathered"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_right_is_refused_by_name(why):
    bsdf, settings, message = REFUSED[why]
    scene = {"type": "scene", "integrator": {"type": "bssrdf", **settings}, "object": {**BALL, "bsdf": bsdf()}}
    scene = mi.load_dict({**scene, "sky": {"type": "constant"}})
    with pytest.raises(ValueError, match=message):
        scene.integrator().prepare(scene)


def test_what_walks_refuse_while_they_render_is_said_in_place_of_what_mitsuba_makes_of_it():
    bsdf, _, message = REFUSED["no slopes"]
    scene = {"type": "scene", "integrator": {"type": "translucent_walk"}, "object": {**BALL, "bsdf": bsdf()}}
    with pytest.raises(ValueError, match=f"^{message}"):
        mi.render(mi.load_dict({**scene, "sensor": {"type": "perspective"}}), spp=1)


def test_a_mask_on_what_holds_something_and_a_map_without_uv_are_refused(tmp_path):
    masked = {"type": "mask", "opacity": 0.5, "of": PLAIN}
    scene = {"type": "scene", "object": {**BALL, "bsdf": masked}, "stone": {"type": "sphere", "radius": 1.0}}
    walk = mi.load_dict({"type": "translucent_walk"})
    with pytest.raises(ValueError, match="mask or blendbsdf must be in no other and hold nothing, got object 'object'"):
        walk.tracer(mi.load_dict(scene))
    box = slab(tmp_path, 0.0)
    text = "\n".join(line for line in open(box["filename"]) if not line.startswith("vt"))
    (tmp_path / "bare.obj").write_text(re.sub(r"(\d+)/\d+/", r"\1//", text))
    bare = {**box, "filename": str(tmp_path / "bare.obj"), "bsdf": _flat(PLAIN)}
    with pytest.raises(ValueError, match="object 'object' must have uv for its normalmap, got a mesh without"):
        walk.tracer(mi.load_dict({"type": "scene", "object": bare}))
