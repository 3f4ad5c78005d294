"""Random input at the three front doors: `python -m tests.fuzz eval 1000` for the first thousand inputs of one.

Each input is made from its number, so `--first N` with the count 1 repeats one. An input is answered, or refused by a
`ValueError` with a sentence. Answers are held to bounds that no model knows: S >= 0, 0 <= R <= 1, finite gradients, and
the coefficients that a file states.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import halfspace_sss as sss
from halfspace_sss.backend import prepare_llvm
from halfspace_sss.materials import files
from halfspace_sss.materials.spectra import read_spectra

ODD = [math.nan, math.inf, -math.inf, -1.0, -1e-300, 0.0, 5e-324, 1e-30, 1 + 1e-15, 1.5, 1e30, 1e308, None, "1", "x",
       "", b"1", 1j, True, (), [], [1.0, 2.0], [[1.0]], {}, object, np.float16(0.5), np.int8(3), 10**400]  # fmt: skip
MODELS = [name for name in sss.models() if name not in ("neural_material", "neural_paper")]
CREATIVE = ("directional_dipole", "forward_scattering_dipole", "photon_beam_diffusion")  # as published, of energy
COSINES = (0.0, 1e-300, 1e-7, 1e-3, 0.5, 1.0, 1 + 2e-16)
Random = np.random.Generator


class RefusedError(Exception):
    """A `ValueError` of the library."""


def ask(function: Callable, *arguments: Any, **named: Any) -> Any:
    """What the library answers; its refusals are told apart from mistakes of the bounds here."""
    try:
        return function(*arguments, **named)
    except ValueError as error:
        raise RefusedError(str(error)) from error


def _one_of(rng: Random, values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


POOL = np.random.default_rng(1)  # indices and cosines of some length, of which tables are kept
ETAS = [1.0, 1.3, *POOL.uniform(1, 2, 20), *(1 + 10 ** POOL.uniform(-16, 0, 8)), *(10 ** POOL.uniform(-1, 1, 8))]
GS = [0.0, 0.9, *POOL.uniform(-1, 1, 20), *POOL.uniform(0, 1, 10), *(1 - 10 ** POOL.uniform(-16, 0, 8))]


def _albedo(rng: Random) -> float:
    return float(_one_of(rng, [rng.random(), 1 - 10 ** rng.uniform(-16, 0), 10 ** rng.uniform(-30, 0), 0.0, 1.0]))


def _g(rng: Random) -> float:
    return float(_one_of(rng, GS))


def _eta(rng: Random) -> float:
    return float(_one_of(rng, ETAS))


def _few(values: list) -> Callable[[Random], float]:
    """Of the first ones: each pair of an index and a cosine takes a table of 0.1 s."""
    return lambda rng: float(_one_of(rng, values[:5]))


def _length(rng: Random) -> float:
    return float(10 ** rng.uniform(*_one_of(rng, [(-3, 3), (-8, 8), (-18, 18)])))


def _given(rng: Random, value: Callable[[Random], Any], odd: float = 0.06, scalar: bool = False) -> Any:
    """A value, now and then one for each of three channels, or an odd one."""
    if rng.random() < odd:
        return _one_of(rng, ODD)
    return [value(rng) for _ in range(3)] if not scalar and rng.random() < 0.15 else value(rng)


INDEX = ("eta", "specular_ior", "ior")
MAKERS = {  # of media -> what they take
    "from_albedo": {"albedo": _albedo, "sigma_t": _length, "g": _g, "eta": _eta},
    "__call__": {"sigma_s": _length, "sigma_a": _length, "g": _g, "eta": _eta},
    "from_reduced": {"sigma_s_prime": _length, "sigma_a": _length, "g": _g, "eta": _eta},
    "from_reflectance": {
        "reflectance": lambda rng: 0.9 * _albedo(rng),
        "mfp": _length,
        "g": _few(GS),
        "eta": _few(ETAS),
    },
    "from_openpbr": {"subsurface_color": _albedo, "subsurface_radius": _length, "specular_ior": _few(ETAS)},
    "from_principled": {"base_color": _albedo, "subsurface_scale": _length, "subsurface_anisotropy": _few(GS)},
    "from_gltf": {"multiscatter_color": _albedo, "attenuation_distance": _length, "attenuation_color": _albedo},
}
MAKER = ["from_albedo"] * 12 + ["__call__"] * 4 + list(MAKERS)


def check_medium(medium: sss.Medium) -> None:
    """What holds for every medium."""
    values = [np.asarray(getattr(medium, name)) for name in ("albedo", "sigma_t", "g", "mfp", "sigma_t_prime")]
    assert all(np.isfinite(value).all() for value in values), medium
    albedo, sigma_t, g, *_ = values
    assert (albedo >= 0).all() and (albedo <= 1).all() and (sigma_t > 0).all() and (np.abs(g) < 1).all(), medium


def check_reflectance(medium: sss.Medium, mu: float | str) -> None:
    """0 <= R <= 1."""
    R = np.asarray(ask(medium.reflectance, mu))
    assert np.isfinite(R).all() and (R >= 0).all() and (R <= 1).all(), (medium, mu, R)


def _medium(rng: Random) -> sss.Medium:
    name = _one_of(rng, MAKER)
    make = sss.Medium if name == "__call__" else getattr(sss.Medium, name)
    medium = ask(make, **{key: _given(rng, value, 0.02, key in INDEX) for key, value in MAKERS[name].items()})
    check_medium(medium)
    return medium


def _argument(rng: Random, value: Callable[[Random], float], library: str) -> Any:
    """An argument of a query in a library."""
    if rng.random() < 0.03:
        return _one_of(rng, ODD)
    shape = _one_of(rng, [(), (), (3,), (2, 1), (1,), (0,), (4,)]) if rng.random() < 0.3 else ()
    number = value(rng) if not shape else np.array([value(rng) for _ in range(math.prod(shape))]).reshape(shape)
    kind = _one_of(rng, ["float64"] * 6 + ["float32", "float16", "int64", "bool", "object", "complex128", "U9"])
    if library == "python":
        if rng.random() < 0.8 or not shape:
            return number if rng.random() < 0.9 else np.asarray(number).astype(kind)
        return np.asarray(number).tolist()
    if library == "torch":
        import torch

        return torch.as_tensor(np.asarray(number).astype(kind if kind not in ("object", "U9") else "float32"))
    from halfspace_sss.backend import array_types

    return array_types("llvm").Float(np.ravel(number).astype(np.float32)) if rng.random() < 0.8 else number


def _check_S(model: sss.BSSRDF, query: list, library: str) -> None:
    S = ask(model.eval, *query)
    values = np.asarray(S.numpy() if hasattr(S, "numpy") else S)
    if library != "drjit":
        assert np.isfinite(values).all() and (values >= 0).all(), values
        shape = np.broadcast_shapes(*(np.shape(value) for value in query))
        channels = () if model.medium.n_channels is None else (model.medium.n_channels,)
        assert values.shape == (*shape, *channels), (values.shape, shape)
    elif all(_in_range(name, value) for name, value in zip(QUERY, query)):
        assert np.isfinite(values).all() and (values >= 0).all(), values


def _in_range(name: str, value: Any) -> bool:
    value = np.asarray(value, dtype=float)
    return bool(np.isfinite(value).all() and (name[:3] == "phi" or (value >= 0).all() and (value <= 1).all()))


def _check_gradients(model: sss.BSSRDF, query: list) -> None:
    """Finite, wherever S is finite and the query inside its bounds."""
    import torch

    # a cosine that is 1 in the single precision of another argument may be above 1 here
    values = [min(float(value), 1.0) if name[:2] == "mu" else float(value) for name, value in zip(QUERY, query)]
    tensors = [torch.as_tensor(value, dtype=torch.float64).requires_grad_() for value in values]
    S = model.eval(*tensors)
    for value, tensor in zip(torch.autograd.grad(S.sum(), tensors, allow_unused=True), tensors):
        assert value is None or torch.isfinite(value).all(), (value, tensor)


QUERY = {
    "r": lambda rng: 0.0 if rng.random() < 0.05 else _length(rng),
    "mu_i": lambda rng: float(_one_of(rng, COSINES)) if rng.random() < 0.2 else rng.random(),
    "phi_i": lambda rng: rng.uniform(-7, 7),
    "mu_o": lambda rng: float(_one_of(rng, COSINES)) if rng.random() < 0.2 else rng.random(),
    "phi_o": lambda rng: rng.uniform(-7, 7) if rng.random() < 0.9 else _length(rng),
}


def evaluate(rng: Random, folder: Path) -> None:
    """A medium, a model and a query; of few also reflectances and gradients."""
    medium = _medium(rng)
    if rng.random() < 0.02:
        check_reflectance(medium, "diffuse" if rng.random() < 0.5 else QUERY["mu_i"](rng))
    model = ask(sss.bssrdf, _one_of(rng, MODELS) if rng.random() < 0.99 else _one_of(rng, ODD), medium)
    library = _one_of(rng, ["python"] * 36 + ["torch"] * 3 + ["drjit"])
    query = [_argument(rng, value, library) for value in QUERY.values()]
    if rng.random() < 0.01:
        R = np.asarray(ask(sss.measure.reflectance, model, rng.random()))
        assert np.isfinite(R).all() and (R >= 0).all() and (model.name in CREATIVE or (R <= 1 + 1e-6).all()), (model, R)
    _check_S(model, query, library)
    if library == "python" and rng.random() < 0.05 and all(np.shape(value) == () for value in query):
        _check_gradients(model, query)


# ---- Material files


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(value) if math.isfinite(value) else f"{value:+}"
    return repr(value) if isinstance(value, int) else '"{}"'.format(str(value).replace("\\", "").replace('"', ""))


PAIRS = (("sigma_s", "sigma_a"), ("sigma_s_prime", "sigma_a"), ("sigma_t", "albedo"))


def material_file(rng: Random, folder: Path) -> None:
    """TOML with one material, read to what it says."""
    if rng.random() < 0.4:
        return spectra_file(rng, folder)
    unit = _one_of(rng, ["1/mm", "1/cm"]) if rng.random() < 0.97 else _one_of(rng, ODD)
    top = {"set": "mine", "unit": unit, "source": "measured"}
    if rng.random() < 0.4:
        top["channels"] = ["R", "G", "B"] if rng.random() < 0.95 else _one_of(rng, ODD)
    values = {"albedo": _albedo, "g": _g}
    entry = {"name": "wax", "eta": _given(rng, _eta, 0.03, scalar=True)}
    pair = _one_of(rng, PAIRS)
    for key in (*pair, "g"):
        if key == "g" and rng.random() < 0.2:
            continue
        value = values.get(key, _length)
        several = "channels" in top and rng.random() < 0.6
        entry[key] = [value(rng) for _ in range(3)] if several else _given(rng, value, 0.02)
    for _ in range(int(rng.integers(0, 2))):
        key = _one_of(rng, ["g", "note", "dilutable", "sample_ml", "sigma_a", "albedo", "eta", "x", "sigma_T", "name"])
        (top if rng.random() < 0.2 else entry)[key] = _one_of(rng, [*ODD, _length(rng), _g(rng)])
    lines = [f"{key} = {_toml(value)}" for key, value in top.items()]
    lines += ["[[material]]", *(f"{key} = {_toml(value)}" for key, value in entry.items())]
    (material,) = ask(files.parse, "\n".join(lines), "wax.toml")
    check_medium(material.medium)
    _check_stated(material.medium, entry, 10.0 if top["unit"] == "1/cm" else 1.0)
    if rng.random() < 0.02:
        check_reflectance(material.medium, "diffuse")


def _check_stated(medium: sss.Medium, entry: dict, per_mm: float) -> None:
    """The coefficients are those of the file."""
    (pair,) = [each for each in PAIRS if all(key in entry for key in each)]
    first, second = (np.asarray(entry[key], dtype=float) for key in pair)
    g = np.asarray(entry.get("g", 0.0), dtype=float)
    scatters = (second if pair[1] == "albedo" else first) > 0
    g = np.where(scatters, g, 0.0)
    if pair[1] == "albedo":
        sigma_s, sigma_a = second * first / per_mm, (1 - second) * first / per_mm
    else:
        sigma_s, sigma_a = first / per_mm, second / per_mm
    sigma_s = sigma_s / (1 - g) if pair[0] == "sigma_s_prime" else sigma_s
    for value, stated in ((medium.sigma_s, sigma_s), (medium.sigma_a, sigma_a), (medium.g, g)):
        np.testing.assert_allclose(value, stated, rtol=1e-14)
    assert medium.eta == float(np.ravel(entry["eta"])[0])


def spectra_file(rng: Random, folder: Path) -> None:
    """A CSV file of spectra, read to what it says."""
    names = ["wavelength", "mu_a", "mu_s" if rng.random() < 0.6 else "mu_s'", "g", "n"]
    if rng.random() < 0.1:
        names[int(rng.integers(5))] = _one_of(rng, ["", "x", "mu_s", "wavelength", "N"])
    values = (
        lambda k: 300 + 70.0 * k,
        lambda k: _length(rng),
        lambda k: _length(rng),
        lambda k: _g(rng),
        lambda k: _eta(rng),
    )
    rows = [[value(k) for value in values] for k in range(int(rng.integers(0, 9)))]
    for _ in range(int(rng.random() < 0.2) * len(rows)):
        rows[int(rng.integers(len(rows)))][int(rng.integers(5))] = _one_of(rng, ODD)
    order = rng.permutation(5) if rng.random() < 0.5 else range(5)
    text = "\n".join(",".join(str(row[k]) for k in order) for row in [names, *rows])
    if rng.random() < 0.1:
        at = int(rng.integers(len(text)))
        text = _one_of(rng, [text[:at], text[:at] + "\n" + text[at:], text[:at] + '"' + text[at:], "\ufeff" + text])
    path = folder / "wax.csv"
    path.write_text(text, encoding="utf-8")
    unit = _one_of(rng, [None, "1/mm", "1/cm"])
    spectra = ask(read_spectra, path, unit)
    assert len(spectra.wavelengths) == len(rows) or text.count("\n") != len(rows)
    check_medium(ask(spectra.medium, spectra.wavelengths))
    if rng.random() < 0.05:
        R = ask(spectra.reflectance, spectra.wavelengths[:2])
        assert (R >= 0).all() and (R <= 1).all(), R
    if rng.random() < 0.02:
        check_medium(ask(spectra.to_rgb).medium)


# ---- Scene files


SCALE = '<transform name="to_world"><scale value="{!r}"/></transform>'
SHAPES = {  # with a translucent surface in the place of {}
    "sphere": '<shape type="sphere" id="object"><float name="radius" value="{size!r}"/>{{}}</shape>',
    "cube": '<shape type="cube" id="object">{scale}{{}}</shape>',
    "rectangle": '<shape type="rectangle" id="object">{{}}</shape>',
    "disk": '<shape type="disk" id="object">{scale}{{}}</shape>',
    "cylinder": '<shape type="cylinder" id="object"><float name="radius" value="{size!r}"/>{{}}</shape>',
}
LIGHTS = [
    '<emitter type="constant"/>', '<emitter type="point"><point name="position" x="3" y="4" z="9"/></emitter>',
    '<emitter type="directional"><vector name="direction" x="0" y="-1" z="-1"/></emitter>', "",
    '<shape type="sphere"><point name="center" x="9" y="9" z="40"/><emitter type="area"/></shape>',
    '<shape type="rectangle"><transform name="to_world"><scale value="9"/><translate z="-90"/></transform></shape>',
]  # fmt: skip
AROUND = ["{}"] * 12 + [
    '<bsdf type="twosided">{}</bsdf>', '<bsdf type="mask"><float name="opacity" value="0.5"/>{}</bsdf>',
    '<bsdf type="blendbsdf"><float name="weight" value="0.5"/>{}<bsdf type="diffuse"/></bsdf>',
    '<bsdf type="bumpmap"><texture name="arbitrary" type="checkerboard"/>{}</bsdf>',
]  # fmt: skip
INSIDE = [""] * 12 + [
    '<bsdf type="dielectric"><float name="int_ior" value="1.3"/><float name="ext_ior" value="1"/></bsdf>',
    '<bsdf type="roughdielectric"><float name="int_ior" value="1.3"/><float name="ext_ior" value="1"/></bsdf>',
    '<bsdf type="plastic"/>', '<texture name="albedo" type="checkerboard"/>', '<float name="x" value="1"/>',
]  # fmt: skip
SCENE = """<scene version="3.0.0"> {integrator} {lights} {object}
  <sensor type="perspective"><float name="fov" value="20"/>
    <transform name="to_world"><lookat origin="0,0,{distance!r}" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler></sensor></scene>
"""
STATED = {"sigma_s": ("sigma_a", _length), "sigma_t": ("albedo", _albedo)}
WORDS = {
    "model": ["better_dipole", "standard_dipole", "normalized_diffusion", "lambert", "neural", "neural",
              "full_geometry"],
    "orders": ["total", "multiple", "single"], "material": ["marble", "ketchup", "skimmilk", "Marble", "soap"],
    "reflection": ["true", "false"], "channel": ["R", "0"], "dilution": ["0.1"], "unit": ["1/cm"],
}  # fmt: skip
SETTINGS = {
    "mm_per_unit": ("float", _length), "max_depth": ("integer", lambda rng: int(rng.integers(-2, 6))),
    "rr_depth": ("integer", lambda rng: int(rng.integers(0, 6))), "hide_emitters": ("boolean", lambda rng: "true"),
    "light": ("string", lambda rng: _one_of(rng, ["sampled", "gathered", "corrected", "auto", "precomputed", "x"])),
    "area_share": ("float", lambda rng: rng.uniform(-0.1, 1.1)), "blur": ("float", _length),
    "entries": ("integer", lambda rng: 2),
    "tolerance": ("float", _length), "depth": ("integer", lambda rng: 3),
}  # fmt: skip


def _property(rng: Random, key: str, value: Any, kind: str | None = None) -> str:
    """A property as a number or a text."""
    if isinstance(value, list):
        kind, value = "string", ", ".join(map(str, value))
    kind = kind or ("float" if rng.random() < 0.8 else "string")
    text = str(value).replace("<", "").replace(">", "").replace('"', "")
    return f'<{kind} name="{key}" value="{text}"/>'


def scene_text(rng: Random) -> tuple[str, dict]:
    """A scene file, and the coefficients that it states; of one in three with something odd, none."""
    stated: dict[str, Any] = {}
    if rng.random() < 0.85:
        first = _one_of(rng, list(STATED))
        second, value = STATED[first]
        stated = {first: 10 ** rng.uniform(-2, 2), second: value(rng)}
        stated |= {"g": _g(rng)} if rng.random() < 0.5 else {}
        stated |= {"eta": _eta(rng)} if rng.random() < 0.5 else {}
        stated = {
            key: [v, v / 2, v / 3] if key not in ("eta", "g") and rng.random() < 0.2 else v for key, v in stated.items()
        }
    words = {
        key: _one_of(rng, values) for key, values in WORDS.items() if rng.random() < (0.5 if key == "model" else 0.03)
    }
    words |= {} if stated else {"material": "marble"} if rng.random() < 0.9 else {}
    properties = [_property(rng, key, value) for key, value in stated.items()]
    properties += [_property(rng, k, v, "boolean" if k == "reflection" else "string") for k, v in words.items()]
    surface = f'<bsdf type="translucent">{"".join(properties)}{_one_of(rng, INSIDE)}</bsdf>'
    size = float(10 ** rng.uniform(-1, 1.5))
    shape = (
        SHAPES[_one_of(rng, list(SHAPES))]
        .format(size=size, scale=SCALE.format(size))
        .format(_one_of(rng, AROUND).format(surface))
    )
    settings = [_property(rng, key, value(rng), kind) for key, (kind, value) in SETTINGS.items() if rng.random() < 0.06]
    kind = _one_of(rng, ["bssrdf", "translucent_walk", "bssrdf", "translucent_walk", "path", "volpath"])
    lights = "".join(_one_of(rng, LIGHTS) for _ in range(2))
    text = SCENE.format(integrator=f'<integrator type="{kind}">{"".join(settings)}</integrator>', lights=lights,
                        object=shape, distance=8 * size)  # fmt: skip
    if rng.random() < 0.7:
        return text, {} if "texture" in surface or "material" in words else stated
    for _ in range(int(rng.integers(1, 3))):
        text = _one_of(rng, [_other_value, _other_kind, _other_text])(rng, text)
    return text, {}


def _other_value(rng: Random, text: str) -> str:
    values = re.findall(r'(?:value|name|type|x|id)="[^"]*"', text)
    key, old = _one_of(rng, values).split("=", 1)
    return text.replace(f"{key}={old}", '{}="{}"'.format(key, re.sub('[<>"]', "", str(_one_of(rng, ODD)))), 1)


def _other_kind(rng: Random, text: str) -> str:
    kind = _one_of(rng, re.findall(r'<(\w+) name="[^"]*" value', text))
    other = _one_of(rng, ["integer", "boolean", "rgb", "point", "spectrum", "float", "string", "vector", "ref"])
    return text.replace(f"<{kind} name", f"<{other} name", int(rng.integers(1, 4)))


def _other_text(rng: Random, text: str) -> str:
    at = int(rng.integers(len(text)))
    return (
        text[:at] + _one_of(rng, ["", "<", '"', "</shape>", "&x;", "\x00", "$name"]) + text[at + int(rng.integers(9)) :]
    )


def load(text: str, folder: Path) -> Any:
    """The scene of a file, by the library."""
    from full_geometry.scenes.scene_files import load_scene

    (folder / "scene.xml").write_text(text)
    return ask(load_scene, folder / "scene.xml")


def scene_file(rng: Random, folder: Path) -> None:
    """A scene, loaded to the medium that it states."""
    from full_geometry.surface.wrapped import surface_of

    text, stated = scene_text(rng)
    scene = load(text, folder)
    found = [surface.spec.medium for surface in map(surface_of, scene.shapes()) if surface is not None]
    assert found
    for medium in found:
        check_medium(medium)
        for key, value in stated.items():
            np.testing.assert_allclose(np.float32(getattr(medium, key)), np.float32(value), rtol=2e-6, err_msg=key)


def render(rng: Random, folder: Path) -> None:
    """An image of 4 x 4 pixels of the first scene of ours that loads: finite, and not negative by models."""
    import mitsuba as mi

    for _ in range(40):
        text, _ = scene_text(rng)
        if 'path"' in text:  # an integrator of Mitsuba's own
            continue
        try:
            scene = load(text, folder)
        except RefusedError:
            continue
        image = np.array(ask(mi.render, scene, spp=4))
        assert np.isfinite(image).all(), (text, image)
        signed = "translucent_walk" in text or "corrected" in text  # estimators of few samples, with control variates
        assert signed or (image >= 0).all(), (text, image)
        return
    raise RefusedError("no scene in 40 loads")


DOORS: dict[str, Callable[[Random, Path], None]] = {
    "eval": evaluate,
    "materials": material_file,
    "scenes": scene_file,
    "renders": render,
}


def run(door: str, first: int, count: int, folder: Path) -> tuple[Counter, list[str]]:
    """Numbers of answered and refused inputs, and what went wrong, each with its number."""
    counts, wrong = Counter(), []
    for k in range(first, first + count):
        try:
            DOORS[door](np.random.default_rng([len(door), k]), folder)
            counts["answered"] += 1
        except RefusedError as error:
            text = str(error)
            counts["refused"] += 1
            if not text or "Traceback" in text or "_" == text[0]:
                wrong.append(f"{door} {k}: {error!r}")
        except Exception:
            wrong.append(f"{door} {k}: {traceback.format_exc()}")
    return counts, wrong


def prepare() -> None:
    """Mitsuba with the plugins."""
    prepare_llvm()
    import mitsuba as mi

    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("door", choices=DOORS)
    parser.add_argument("count", type=int)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    prepare()
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        counts, wrong = run(options.door, options.first, options.count, Path(folder))
    print(f"{options.door}: {counts['answered']} answered, {counts['refused']} refused, {len(wrong)} wrong")
    print("\n".join(wrong[:40]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
