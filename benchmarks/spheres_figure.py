"""What the half-space costs on curved shapes: spheres of decreasing radius, models over path tracing.

`neural_shape` knows that they are curved.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from figures.computing import contenders
from figures.computing.learnt import weight_files
from figures.computing.scans import prepare
from figures.parts.part import Params, Part, Result, SceneDict, Task
from halfspace_sss.comparison.style import COLUMN, look, paper, saved
from halfspace_sss.physics.medium import Medium

TITLE = "bias of the half-space and of `neural_shape` on spheres of decreasing radius"
MODELS = (*contenders.MODELS, "neural_shape")
RADII = (1.0, 3.0, 10.0, 30.0, 100.0)  # mean free paths
MEDIUM = {"albedo": 0.95, "g": 0.0, "eta": 1.3}
LIGHTS = ("even sky", "half a sky from the left")
PATH_TRACED = "path_traced"
SIZE = {"draft": 24, "paper": 64}
SPP = {"draft": 64, "paper": 1024}
RUNS = 4  # of independent seeds, whose spread is the error


def parts(quality: str) -> list[Part]:
    """The mean radiance of each sphere under each light, path traced and by each model."""
    medium = Medium.from_albedo(MEDIUM["albedo"], 1.0, MEDIUM["g"], MEDIUM["eta"])
    results = []
    for model in (PATH_TRACED, *MODELS):
        for light in LIGHTS:
            params = {"model": model, "light": light, "radii": list(RADII), "medium": MEDIUM}
            params |= {"size": SIZE[quality], "spp": SPP[quality]}
            inputs = () if model == PATH_TRACED else weight_files(model, medium)
            like = "walk" if model == PATH_TRACED else "model"
            results.append(Part(f"{light}, {model}", measured, params, SPP[quality], inputs=inputs, like=like))
    return results


def measured(task: Task) -> dict[str, object]:
    """Mean radiance of the spheres, and its standard error."""
    import warnings

    import mitsuba as mi

    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p, means, errors = task.params, [], []
    for k, radius in enumerate(p["radii"]):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "object .* mean free paths across")
            scene = load_scene(_scene(radius, p), p["model"])
        runs = [np.array(mi.render(scene, spp=p["spp"], seed=seed)).mean() for seed in range(RUNS)]
        means.append(float(np.mean(runs)))
        errors.append(float(np.std(runs, ddof=1) / np.sqrt(RUNS)))
        task.progress(k + 1, len(p["radii"]))
    return {"mean": means, "standard_error": errors}


def _scene(radius: float, p: Params) -> SceneDict:
    """A sphere of sigma_t 1 that fills an orthographic image; its boundary reflects, all orders."""
    import mitsuba as mi

    m = p["medium"]
    film = {"type": "hdrfilm", "width": p["size"], "height": p["size"], "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at([0, 0, 3 * radius], [0, 0, 0], [0, 1, 0]).scale([radius, radius, 1])
    surface = {"type": "translucent", "sigma_s": m["albedo"], "sigma_a": 1 - m["albedo"], "g": m["g"], "eta": m["eta"]}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "hide_emitters": True},
        "light": _sky(p["light"]),
        "sphere": {"type": "sphere", "radius": radius, "bsdf": surface},
        "sensor": {"type": "orthographic", "to_world": to_world, "film": film},
    }


def _sky(light: str) -> SceneDict:
    """Radiance 1 from everywhere, or from one half of all directions."""
    import mitsuba as mi

    if light == "even sky":
        return {"type": "constant"}
    pixels = np.zeros((16, 32, 3), np.float32)
    pixels[:, :16] = 1
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels)}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """Model over path tracing against the radius, and the numbers as a table."""
    import pandas
    from matplotlib.figure import Figure

    rows = []
    with paper():
        figure = Figure(figsize=(2 * COLUMN, 2.4), layout="constrained")
        axes = figure.subplots(1, len(LIGHTS), sharey=True)
        for ax, light in zip(axes, LIGHTS):
            truth = results[f"{light}, {PATH_TRACED}"].numbers
            for model in MODELS:
                result = results[f"{light}, {model}"].numbers
                ratio, error = _ratio(result, truth)
                style = look(model)
                ax.errorbar(RADII, ratio, 2 * error, color=style.color, ls=style.dash, label=style.label, capsize=1.5)
                rows += [
                    {"light": light, "model": model, "radius_mfp": r, "ratio": a, "standard_error": e}
                    for r, a, e in zip(RADII, ratio, error)
                ]
            ax.axhline(1, color="k", lw=0.7)
            ax.set(xscale="log", xlabel="radius [mean free paths]", title=light)
        axes[0].set(ylabel="mean radiance, model / path traced")
        figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=3)
        files: dict[str, bytes | str] = {f"spheres.{end}": data for end, data in saved(figure).items()}
    files["spheres.csv"] = pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    return files


def _ratio(values: Params, truth: Params) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.array(values["mean"]), np.array(truth["mean"])
    relative = np.hypot(np.array(values["standard_error"]) / a, np.array(truth["standard_error"]) / b)
    return a / b, a / b * relative
