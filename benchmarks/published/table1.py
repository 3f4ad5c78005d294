"""Table 1: time of training and of rendering, samples and size of weights of the learnt models, the paper's beside.

Both rivals stand beside ours on the objects of Fig. 7, whose parts they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from benchmarks.published import fig07
from benchmarks.tables import in_markdown
from figures.computing.contenders import OF_OBJECTS
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, weight_files
from figures.computing.scans import BUNNY, MATERIALS
from figures.drawing.image_grid import label
from figures.fig09 import LIGHTS, rendered
from figures.parts.part import Part, Result, Row
from halfspace_sss import materials

TITLE = "time of training and rendering, samples and size of weights, the paper's beside"
SUBJECTS = {"draft": ("potato",), "paper": MATERIALS}
MODELS = ("neural", *OF_OBJECTS)
SIZES = {"draft": 64, "paper": 384}
SPP = {"draft": 64, "paper": 1024}
SEVERAL = 4  # entries of an exit, beside 1
WITH_SEVERAL = {"draft": (FULL_GEOMETRY,), "paper": OF_OBJECTS}
NOTES = """\
The bunny of Fig. 9 on this machine, LLVM backend, sampled light. *Training* in CPU seconds, compilation of kernels
included where they were not in Dr.Jit's cache; *render* in CPU seconds for the image, without compilation; *samples* of
all pixels together.
`neural` and `neural_shape` come trained for all media and take no time for an object. The paper's numbers are those of
its authors, for its own networks on their machine: they stand beside for their order of magnitude."""
RIVALS_NOTES = """\
The objects of Fig. 7, in its quality. Deng et al.: the photographs it takes, and the fit of its textures, the albedo of
each vertex in half precision. TG et al.: walks and network, in half precision. *Render*: CPU seconds of a million
samples of the image, compilation and gathered light left out. A sample of TG et al. is a sum over all directions of the
environment."""


class Stated(NamedTuple):
    """What is known of the paper's own networks."""

    network: str
    training: str
    machine: str
    kilobytes: float


PAPER = (
    Stated("half-space, one material", "2118", "NVIDIA RTX 4090", 770.0),
    Stated("full geometry, one object", "1300 to 1650", "NVIDIA RTX 4090", 770.0),
)


def parts(quality: str) -> list[Part]:
    """For each material the training of the bunny, then an image by each model and number of entries."""
    size, spp, results = SIZES[quality], SPP[quality], []
    for material in SUBJECTS[quality]:
        if FULL_GEOMETRY in MODELS:
            results.append(train_scan(material, material, CHUNKS[quality]))
        for model, entries in _cases(quality):
            params = {"material": material, "size": size, "seed": 0, "spp": spp, "model": model, "entries": entries}
            params |= {"lights": LIGHTS, "light": "sampled"}
            needs = (training_of(material),) if model == FULL_GEOMETRY else ()
            inputs = (BUNNY, *weight_files(model, materials.load(material).medium))
            work = spp * size**2 * entries
            results.append(Part(_name(material, model, entries), rendered, params, work, needs, inputs, model))
    told = {part for pair in _rivals() for part in pair}
    return results + [part for part in fig07.parts(quality) if part.name in told]


def _rivals() -> dict[tuple[str, str], tuple[str, str]]:
    """Object and label by the parts of Fig. 7 that tell the training and the image: one part for both of the rivals."""
    return {
        (training_of(name) if method == FULL_GEOMETRY else f"{name}, {method}", f"{name}, {method}"): (name, shown)
        for name in fig07.OBJECTS
        for method, shown in fig07.LABELS.items()
    }


def _cases(quality: str) -> list[tuple[str, int]]:
    """Models with numbers of entries."""
    return [(model, n) for model in MODELS for n in ((1, SEVERAL) if model in WITH_SEVERAL[quality] else (1,))]


def _name(material: str, model: str, entries: int) -> str:
    return f"{material}, {model}, N = {entries}"


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The rows as CSV, and both tables as Markdown."""
    import pandas

    of_rivals = {part for pair in _rivals() for part in pair}
    subjects = dict.fromkeys(name.split(", ")[0] for name in results if name not in of_rivals)
    cases = [(material, *case) for material in subjects for case in _cases("paper")]
    rows = pandas.DataFrame([_row(results, *case) for case in cases if _name(*case) in results])
    beside = pandas.DataFrame(PAPER).rename(columns={"training": "training, s", "kilobytes": "weights, kB"})
    rivals = pandas.DataFrame([
        {"object": name, "method": shown, "training, CPU s": results[training].numbers["cpu seconds"],
         "weights, kB": results[training].numbers["kB"], "render, CPU s per 10⁶": _per_million(results[image])}
        for (training, image), (name, shown) in _rivals().items() if image in results
    ])  # fmt: skip
    text = ["# Time, samples and size", NOTES, in_markdown(rows), "## Beside the rivals", RIVALS_NOTES,
            in_markdown(rivals), "## As published", in_markdown(beside)]  # fmt: skip
    return {
        "table1.csv": rows.to_csv(index=False, lineterminator="\n"),
        "table1_rivals.csv": rivals.to_csv(index=False, lineterminator="\n"),
        "table1_paper.csv": beside.to_csv(index=False, lineterminator="\n"),
        "table1.md": "\n\n".join(text) + "\n",
    }


def _per_million(result: Result) -> float:
    """CPU seconds of a million samples of an image."""
    rows, columns = result.images["image"].shape[:2]
    return 1e6 * result.numbers["cpu seconds of a sample"] / (rows * columns)


def _row(results: Mapping[str, Result], material: str, model: str, entries: int) -> Row:
    result = results[_name(material, model, entries)]
    pixels = result.images["image"].shape[0] * result.images["image"].shape[1]
    row = {"material": material, "model": label(model), "N": entries, "training, CPU s": 0.0, "steps": 0, "walks": 0}
    if model == FULL_GEOMETRY:
        learnt = results[training_of(material)].numbers
        row |= {"training, CPU s": learnt["cpu seconds"], "steps": learnt["steps"], "walks": learnt["walks"]}
        size = learnt["kB"]
    else:
        size = sum(Path(file).stat().st_size for file in weight_files(model, materials.load(material).medium)) / 1000
    samples = result.numbers["spp"] * pixels
    seconds = result.numbers["seconds"]
    row |= {"weights, kB": size, "samples": samples, "render, CPU s": seconds}
    return {**row, "CPU s per 10⁶": 1e6 * seconds / samples}
