"""The registry: where materials come from, and finding one by name."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.checks import did_you_mean
from halfspace_sss.extensions import FAILURES, warn_left_out
from halfspace_sss.materials.material import Material, key_of
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import write_atomically

if TYPE_CHECKING:
    import pandas


ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_MATERIALS"
ENTRY_POINT_GROUP = "halfspace_sss.materials"
IN_CODE = "register()"
State = tuple[dict[str, Material], dict[str, str]]  # materials and where they come from, by key


class Registry:
    """Materials by name, read on first use; an addition takes effect as a whole or not at all, in any thread."""

    def __init__(self) -> None:
        self._materials: dict[str, Material] = {}
        self._origins: dict[str, str] = {}
        self._complete = False
        self._lock = threading.RLock()

    def add(self, results: list[tuple[str, Material]]) -> None:
        """Add materials, each behind what it comes from."""
        with self._lock:
            self.all()
            self._materials, self._origins = self._with(results, (self._materials, self._origins))

    def all(self) -> dict[str, Material]:
        """All materials by key."""
        with self._lock:
            if not self._complete:
                self._materials, self._origins = self._read()
                self._complete = True
            return self._materials

    def _read(self) -> State:
        """All materials that are installed; those of a package that fails are left out with a warning."""
        state = self._with(list(_own()), ({}, {}))
        for entry in entry_points(group=ENTRY_POINT_GROUP):
            try:
                state = self._with(list(_from_entry_point(entry)), state)
            except FAILURES as error:
                warn_left_out(ENTRY_POINT_GROUP, entry.name, error)
        return self._with(list(_of_user()), state)

    def _with(self, result: Iterable[tuple[str, Material]], state: State) -> State:
        """The materials and origins of `state` and those found; ValueError if a name is taken."""
        (materials, origins), added = map(dict, state), set()
        for origin, material in result:
            key = key_of(material.name)
            if key in materials and (key in added or not self._comes_again(key, origin, material)):
                taken = f"{materials[key].name!r} of {origins[key]}"
                raise ValueError(f"{origin}: key name must be new, got {material.name!r}, which is {taken}")
            materials[key], origins[key] = material, origin
            added.add(key)
        return materials, origins

    def _comes_again(self, key: str, origin: str, material: Material) -> bool:
        """Whether a material may take the place of a registered one of that name: it is equal, or of the same file."""
        if not self._complete:
            return False
        return material == self._materials[key] or (origin == self._origins[key] != IN_CODE)


def _own() -> Iterator[tuple[str, Material]]:
    from halfspace_sss.materials.files import parse

    data = resources.files("halfspace_sss.materials").joinpath("data")
    for file in sorted(data.iterdir(), key=lambda f: f.name):
        if file.name.endswith(".toml"):
            origin = f"halfspace_sss/materials/data/{file.name}"
            for material in parse(file.read_text(encoding="utf-8"), origin):
                yield origin, material


def _of_user() -> Iterator[tuple[str, Material]]:
    variable, default = ("APPDATA", "AppData/Roaming") if os.name == "nt" else ("XDG_CONFIG_HOME", ".config")
    folder = Path(os.environ.get(variable) or Path.home() / default) / "halfspace-sss" / "materials"
    if folder.is_dir():
        yield from _from_path(folder)
    for path in os.environ.get(ENVIRONMENT_VARIABLE, "").split(os.pathsep):
        if path:
            if not Path(path).exists():
                raise ValueError(f"{ENVIRONMENT_VARIABLE} must list existing folders or files, got {path!r}")
            yield from _from_path(path)


def _from_path(path: str | os.PathLike[str]) -> Iterator[tuple[str, Material]]:
    from halfspace_sss.materials.files import read

    path = Path(path)
    for file in sorted(path.glob("*.toml")) if path.is_dir() else [path]:
        for material in read(file):
            yield str(file), material


def _from_entry_point(entry: EntryPoint) -> Iterator[tuple[str, Material]]:
    origin, offered = f"entry point {entry.name!r} of group {ENTRY_POINT_GROUP}", entry.load()
    if isinstance(offered, (str, os.PathLike)):
        yield from _from_path(offered)
        return
    if not isinstance(offered, Iterable):
        raise ValueError(f"it must be a path or an iterable of Material, got {offered!r}")
    for material in offered:
        if not isinstance(material, Material):
            raise ValueError(f"it must be a path or an iterable of Material, got an item {material!r}")
        yield origin, material


_registry = Registry()


def names() -> list[str]:
    """Names of all materials, sorted; what an installed package offers and is refused is left out with a warning.

    Raises:
        ValueError: a material file of the user is refused.
    """
    return sorted(material.name for material in _registry.all().values())


def load(name: str, *, dilution: float | None = None, g: float | Sequence[float] | None = None) -> Material:
    """The material of that name.

    Args:
        name: case and separators do not count: "Regular_Chocolate-Milk" is "regular chocolate milk".
        dilution: volume fraction in water in (0, 1], for liquids and powders: sigma_s and sigma_a are multiplied by it,
            g stays. `Material.published_dilution` is the one at which it was measured.
        g: mean cosine in (-1, 1), where only sigma_s_prime was measured: sigma_s = sigma_s_prime / (1 - g).

    Raises:
        ValueError: no such material (the nearest names are given), or dilution or g is out of range or has no meaning
            for this material.
    """
    materials = _registry.all()
    if not isinstance(name, str):
        raise ValueError(f"material must be a name, got {name!r}")
    if key_of(name) not in materials:
        hint = did_you_mean(key_of(name), {key: m.name for key, m in materials.items()}, most=3)
        hint = hint or "; `halfspace-sss materials list` lists them"
        raise ValueError(f"material must be one of the {len(materials)} registered, got {name!r}{hint}")
    material = materials[key_of(name)]
    if g is not None:
        material = material.with_g(g)
    return material if dilution is None else material.diluted(dilution)


def register(material_or_path: Material | str | os.PathLike[str]) -> tuple[str, ...]:
    """Add a `Material`, or all materials of a TOML file or folder, for this process; returns their names.

    A file that is read again replaces what it gave before; an equal material may be added again.

    Raises:
        ValueError: a file is refused (file, key, bound and value are named) or a name is taken; nothing is added then.
    """
    if isinstance(material_or_path, Material):
        results = [(IN_CODE, material_or_path)]
    elif isinstance(material_or_path, (str, os.PathLike)):
        results = list(_from_path(material_or_path))
    else:
        raise ValueError(f"material_or_path must be a Material or a path, got {material_or_path!r}")
    if not results:
        raise ValueError(f"material_or_path must hold at least one *.toml file, got {str(material_or_path)!r}")
    _registry.add(results)
    return tuple(material.name for _, material in results)


def write(path: str | os.PathLike[str], *materials: Material) -> None:
    """Write a material file, which `register` and the registry read again as equal materials.

    Args:
        path: a .toml file; it is replaced.
        materials: at least one; they share set, source, channels, assumptions and sources, which a file has once.

    Raises:
        ValueError: there is no material, the path does not end in .toml, the materials differ in what they must share,
            or one is diluted: write the pure one.
    """
    if not materials:
        raise ValueError("materials must be at least one, got none")
    if Path(path).suffix != ".toml":
        raise ValueError(f"path must end in .toml, got {str(path)!r}")
    write_atomically(Path(path), to_toml(materials))


def to_toml(materials: Sequence[Material]) -> str:
    """The text that `write` writes: coefficients in 1/mm with all their digits."""
    first = materials[0]
    for material in materials:
        for name in ("set", "source", "channels", "assumptions", "sources"):
            ours, wanted = getattr(material, name), getattr(first, name)
            if ours != wanted:
                raise ValueError(
                    f"{name} of {material.name!r} must be that of {first.name!r}, {wanted!r}, got {ours!r}"
                )
        if material.dilution != 1:
            raise ValueError(f"dilution of {material.name!r} must be 1 in a file, got {material.dilution!r}")

    def line(key: str, value: object) -> str:
        return f"{key} = {json.dumps(value, ensure_ascii=False)}"  # texts, lists and numbers are written as in TOML

    lines = [line("set", first.set), line("unit", "1/mm"), line("source", first.source)]
    lines += [line("channels", first.channels)] if first.channels else []
    lines += [line("assumptions", first.assumptions)] if first.assumptions else []
    lines += [line("tank_ml", 1.0)] if any(each.published_dilution for each in materials) else []
    lines += ["", "[sources]", *(line(key, text) for key, text in first.sources.items())] if first.sources else []
    for material in materials:
        m = material.medium
        scattering = {"sigma_s_prime": m.sigma_s_prime} if material.g_assumed else {"sigma_s": m.sigma_s, "g": m.g}
        values = {"name": material.name, "eta": m.eta, **scattering, "sigma_a": m.sigma_a}
        values |= {"sample_ml": material.published_dilution} if material.published_dilution else {}
        values |= {"dilutable": True} if material.dilutable else {}
        values |= {"note": material.note} if material.note else {}
        lines += ["", "[[material]]"]
        lines += [line(key, v.tolist() if isinstance(v, np.ndarray) else v) for key, v in values.items()]
    return "\n".join(lines) + "\n"


def table() -> pandas.DataFrame:
    """All materials as numbers, one row per material and channel.

    Columns: material, set, channel ("" for a medium with one), sigma_s, sigma_a, sigma_t (1/mm), g, eta, albedo,
    sigma_s_prime (1/mm), albedo_prime, source.

    Raises:
        ValueError: as `names`.
    """
    import pandas

    rows = []
    for name in names():
        material = load(name)
        medium = material.medium
        for i, channel in enumerate(material.channels or ("",)):
            row = {"material": name, "set": material.set, "channel": channel}
            for column in ("sigma_s", "sigma_a", "sigma_t", "g", "eta", "albedo", "sigma_s_prime", "albedo_prime"):
                value = np.atleast_1d(getattr(medium, column))
                row[column] = float(value[i] if value.size > 1 else value[0])
            rows.append({**row, "source": material.source})
    return pandas.DataFrame(rows)


def one_channel(medium: Medium | Material | str, channel: int | str | None) -> tuple[str, Medium]:
    """A title and the scalar medium of one channel.

    Args:
        medium: a Medium, a Material, or the name of one.
        channel: name or number; None for the first.

    Raises:
        ValueError: no such material or channel; the message names those there are.
    """
    names: tuple[str, ...] | None = None
    title = ""
    if isinstance(medium, str):
        medium = load(medium)
    if isinstance(medium, Material):
        title, medium, names = medium.name, medium.medium, medium.channels
    if not isinstance(medium, Medium):
        raise ValueError(f"medium must be a Medium, a Material or the name of one, got {medium!r}")
    if medium.n_channels is None:
        if channel is not None and str(channel) != "0":
            raise ValueError(f"channel must be left out for a medium with one channel, got {channel!r}")
        return title, medium
    names = names or tuple(str(k) for k in range(medium.n_channels))
    known = {**{str(k): k for k in range(len(names))}, **{name.casefold(): k for k, name in enumerate(names)}}
    key = "0" if channel is None else str(channel).casefold()
    if key not in known:
        raise ValueError(f"channel must be one of {', '.join(names)}, or a number below {len(names)}, got {channel!r}")
    return f"{title} {names[known[key]]}".strip(), medium.channel(known[key])
