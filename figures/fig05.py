"""Fig. 5: error of the image over time for walks alone, walks that learn, and the model trained before."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from figures.computing.contenders import long_walk
from figures.computing.images import FLIP, RELATIVE_MSE, compared
from figures.computing.scans import BUNNY, prepare, scan_scene
from figures.parts.part import Params, Part, Result, Row, Task
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.learning import online
from full_geometry.scenes import reference
from full_geometry.scenes.reference_store import Reference
from full_geometry.trade.image_differences import srgb
from full_geometry.transport.storing import KIND
from halfspace_sss.comparison.style import TEXT, Look, paper, saved
from halfspace_sss.neural.store import weights_in
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    import mitsuba as mi
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "error of the image over time: walks alone, walks that learn, the model trained before"
SCENES = {  # material and lights
    "draft": (("potato", "small light"),),
    "paper": (("potato", "small light"), ("marble", "small light"), ("potato", "both"), ("marble", "both")),
}
SIZES = {"draft": 48, "paper": 256}
SECONDS = {"draft": 8.0, "paper": 600.0}  # of each way
TRAIN_SECONDS = {"draft": 4.0, "paper": 60.0}
TRUTH_SPP = {"draft": 512, "paper": 16384}
WARM_UP = 0.5  # seconds of learning; the first run compiles
LOOKS = {
    "walks": Look("Walks alone", "#000000", "-"),
    "online": Look("Learnt while rendering", "#C00000", "-"),
    "before": Look("Trained before", "#0072B2", (0, (5, 1.6))),
}


def parts(quality: str) -> list[Part]:
    """For each scene a long path-traced image, then the three ways one after the other."""
    size, seconds, results = SIZES[quality], SECONDS[quality], []
    for material, lights in SCENES[quality]:
        common = {"material": material, "size": size, "lights": lights}
        name, truth = f"{material}, {lights}", {**common, "spp": TRUTH_SPP[quality], "seed": 0}
        results.append(Part(f"{name}: truth", long_walk, truth, truth["spp"] * size**2, inputs=(BUNNY,)))
        times = {"seconds": seconds, "train_seconds": TRAIN_SECONDS[quality]}
        params = {**common, **times, "train_error": 1e-3, "model": KIND, "seed": 1}
        results.append(Part(f"{name}: ways", rivals, params, 3 * seconds, inputs=(BUNNY,)))
    return results


def rivals(task: Task) -> dict[str, object]:
    """Images at growing times of each way, and what was learnt."""
    prepare()
    p, seconds = task.params, task.params["seconds"]
    folder = check_folder(task.folder)
    for name in ("first", "weights"):  # a run that was killed begins anew: its clock is gone
        for path in (folder / name).glob("*"):
            path.unlink()
    for path in folder.glob("*.exr"):
        path.unlink()
    with weights_in(folder / "first"):  # compiles
        trained_online(p, folder, WARM_UP, WARM_UP)
        modelled(p, folder, WARM_UP)
        walked(p, folder, WARM_UP)
    for path in folder.glob("*.*"):
        path.unlink()
    task.progress(1, 4)
    with weights_in(folder / "weights"):
        online = trained_online(p, folder, seconds, p["train_seconds"])
        task.progress(2, 4)
        ways = {"online": online["snapshots"], "before": modelled(p, folder, seconds)}
    task.progress(3, 4)
    ways["walks"] = walked(p, folder, seconds)
    images = {f"{way}-{k}": image for way, shots in ways.items() for k, image in enumerate(shots.images)}
    numbers = {way: {"seconds": shots.times, "spp": shots.spp} for way, shots in ways.items()}
    return {**images, "ways": numbers, "switch": online["switch"], "training": online["training"]}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, and the errors as a table."""
    import pandas

    scenes = list(dict.fromkeys(name.split(":")[0] for name in results))
    tables = {name: _errors(name, results[f"{name}: truth"], results[f"{name}: ways"]) for name in scenes}
    with paper():
        files: dict[str, bytes | str] = {f"fig05.{end}": data for end, data in saved(_figure(results, tables)).items()}
    rows = [row for table in tables.values() for row in table]
    files["fig05.csv"] = pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    return files


def _gain(truth: Result) -> float:
    """Of the images as they are shown: the object's 97th percentile is 1."""
    image = truth.images["image"]
    return 1 / float(np.percentile(image[image.max(axis=2) > 0], 97))


def _errors(scene: str, truth: Result, ways: Result) -> list[Row]:
    """A row for each image: seconds, samples, relMSE and FLIP of the pixels of the object, and the phase."""
    reference, gain = truth.images["image"], np.float32(_gain(truth))
    mask, rows = reference.max(axis=2) > 0, []
    for way, about in ways.numbers["ways"].items():
        for k, (seconds, spp) in enumerate(zip(about["seconds"], about["spp"])):
            shot = compared(way, gain * ways.images[f"{way}-{k}"], gain * reference, mask=mask)
            learning = way == "online" and seconds < ways.numbers["switch"]
            row = {"scene": scene, "way": way, "phase": "learning" if learning else "rendering"}
            rows.append({**row, "seconds": seconds, "spp": spp, **shot.numbers})
    return rows


def _figure(results: Mapping[str, Result], tables: Mapping[str, list[Row]]) -> Figure:
    """A row for each scene: relMSE and FLIP over seconds, and the last images."""
    from matplotlib.figure import Figure

    columns = (1.6, 1.6, 1, 1, 1, 1)
    figure = Figure(figsize=(TEXT, 1.75 * len(tables) + 0.35), layout="constrained")
    grid = figure.subplots(len(tables), len(columns), squeeze=False, width_ratios=columns)
    for axes, (name, rows) in zip(grid, tables.items()):
        truth, ways = results[f"{name}: truth"], results[f"{name}: ways"]
        for ax, key in zip(axes, (RELATIVE_MSE, FLIP)):
            _curves(ax, rows, key, ways.numbers["switch"])
        axes[0].set_title(f"{name}: {_told(ways)}", loc="left", pad=3)
        shown = {"Truth": truth.images["image"]}
        for way, look in LOOKS.items():
            shown[look.label] = ways.images[f"{way}-{len(ways.numbers['ways'][way]['spp']) - 1}"]
        for ax, (label, image) in zip(axes[2:], shown.items()):
            ax.imshow(srgb(_gain(truth) * np.maximum(image, 0)), interpolation="nearest")
            ax.set(xticks=[], yticks=[])
            ax.set_title(label, pad=3, fontsize=7)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, handlelength=2.8)
    return figure


def _curves(ax: Axes, rows: list[Row], key: str, switch: float) -> None:
    for way, look in LOOKS.items():
        points = [(row["seconds"], row[key]) for row in rows if row["way"] == way]
        ax.plot(*zip(*points), color=look.color, ls=look.dash, marker="o", ms=1.8, mew=0, label=look.label)
    ax.axvline(switch, color="0.5", lw=0.7, ls=":", label="Switch to the model")
    ax.set(xscale="log", yscale="log" if key == RELATIVE_MSE else "linear", ylabel=key, xlabel="seconds")
    ax.grid(color="0.9", lw=0.4)


def _told(ways: Result) -> str:
    """The error of the model at the switch, the largest of the channels under constant light."""
    (trained,) = ways.numbers["training"]
    worst = max((row for row in trained["errors"] if row["light"] == "constant"), key=lambda row: row["error"])
    return f"model's error {100 * worst['error']:.1f} ± {100 * worst['standard_error']:.1f} %"


STEP = 1.25  # of the time from one image that is kept to the next


class Snapshots:
    """Images at times that grow by a factor; the clock stands still while one is kept.
    `times`: seconds since the start. `images`: linear radiance (H, W, 3) at those times. `spp`: samples per pixel in
    them."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.images: list[np.ndarray] = []
        self.spp: list[int] = []
        self._started = time.monotonic()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._started

    def add(self, result: Reference, last: bool = False) -> None:
        """Keep an image, if it is time or the last one."""
        now = self.seconds
        if self.times and now < STEP * self.times[-1] and not last:
            return
        if last and self.spp and self.spp[-1] == result.spp:
            return
        now = max(now, self.times[-1] + 1e-6) if self.times else now
        self.times.append(now)
        self.images.append(result.mean[..., :3].astype(np.float32))
        self.spp.append(result.spp)
        self._started += self.seconds - now


def _scene(p: Params, model: str) -> mi.Scene:
    from full_geometry.scenes.scene_files import open_scene

    return open_scene(scan_scene(p["material"], p["size"], p["lights"]), model)


def trained_online(p: Params, folder: Path, seconds: float, train_seconds: float) -> dict[str, object]:
    """The object is learnt and rendered from nothing; weights must not be there.
    `p`: material, size, lights, seed, train_error and model. `folder`: for the image and its parts. `seconds`: in all,
    about. `train_seconds`: of them at most for learning. Returns the snapshots, the seconds at the switch, and what
    `about` tells of the training."""
    result, walks, switch = Snapshots(), [None], [0.0]

    def traced(image: Reference) -> None:
        walks[0] = image
        result.add(image)

    def rendered(image: Reference) -> None:
        if not switch[0]:
            switch[0] = result.seconds - image.seconds
            result.add(walks[0], last=True)
        result.add(online.combined(walks[0], image))

    image = online.render(
        _scene(p, p["model"]), folder / "online.exr", train_seconds=train_seconds, train_error=p["train_error"],
        seed=p["seed"], listeners=online.Listeners(rendered, traced), seconds=max(seconds - train_seconds, 0.1),
        interval=1e9,
    )  # fmt: skip
    result.add(image, last=True)
    return {"snapshots": result, "switch": switch[0], "training": image.about["training"]}


def modelled(p: Params, folder: Path, seconds: float) -> Snapshots:
    """The model renders with weights that are there."""
    return _rendered(_scene(p, p["model"]), folder / "model.exr", p["seed"] + 1, seconds)


def walked(p: Params, folder: Path, seconds: float) -> Snapshots:
    """Walks alone."""
    from full_geometry.settings import PATH_TRACED

    return _rendered(_scene(p, PATH_TRACED), folder / "walked.exr", p["seed"] + 2, seconds)


def _rendered(scene: mi.Scene, path: Path, seed: int, seconds: float) -> Snapshots:
    integrator = scene.integrator()
    if is_bssrdf(integrator):
        integrator.prepare(scene)
    result = Snapshots()
    image = reference.render(scene, path, seed=seed, seconds=seconds, interval=1e9, resume=False, progress=result.add)
    result.add(image, last=True)
    return result
