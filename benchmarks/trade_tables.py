"""The trade on many scenes: small figures of bias over time, and the page of tables `docs/trade.md`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures.drawing.trade_plot import LEAST, NOISE, pareto, span_in_mfp, time_to_noise
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.advice import advise
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade
from full_geometry.trade.techniques import Job, Technique
from halfspace_sss.comparison.style import TEXT
from halfspace_sss.noise_free import short

if TYPE_CHECKING:
    import pandas


def multiples(result: Mapping[tuple[str, str, str], ObjectTrade], tolerance: float) -> Figure:
    """Bias over time for each material, a row, and each shape and light, a column."""
    materials = list(dict.fromkeys(key[0] for key in result))
    columns = list(dict.fromkeys(key[1:] for key in result))
    figure = Figure(figsize=(TEXT, 1.45 * len(materials) + 0.9), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.015, h_pad=0.015, wspace=0.0, hspace=0.01)
    grid = figure.subplots(len(materials), len(columns), squeeze=False, sharex="col", sharey=True)
    handles: dict[str, object] = {}
    for i, material in enumerate(materials):
        for j, (shape, light) in enumerate(columns):
            ax, o = grid[i, j], result.get((material, *columns[j]))
            if o is None:
                ax.set_visible(False)
                continue
            rows = [w for w in o.ways if not w.refusal and w.variance > 0]
            handles |= pareto(ax, rows, o.pixels, tolerance, small=True)
            ax.set_title(f"{material}: {span_in_mfp(o)} mfp", pad=2, size=7)
            ax.set(
                xlabel=f"{shape}, {light}: s to {100 * NOISE:g} % noise" if i == len(materials) - 1 else "", ylabel=""
            )
            ax.label_outer()
    for ax in grid[:, 0]:
        ax.set_ylabel("bias of radiance")
    tops = [w.bias_bound for o in result.values() for w in o.ways if not w.refusal and w.bias2 > 0]
    grid[0, 0].set_ylim(LEAST, 1.6 * max([*tops, tolerance]))
    for j in range(len(columns)):
        _span(grid[0, j], [o for key, o in result.items() if key[1:] == columns[j]])
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _span(ax: Axes, objects: Sequence[ObjectTrade]) -> None:
    xs = [time_to_noise(w, o.pixels) for o in objects for w in o.ways if not w.refusal and w.variance > 0]
    ax.set_xlim(min(xs) / 2, max(xs) * 3)


Scenes = Mapping[tuple[str, str, str], ObjectTrade]
JOBS = ((0.02, 1), (0.05, 1), (0.05, 100), (0.1, 1), (0.2, 1))  # tolerance, images
INTRODUCTION = """\
# Speed against accuracy on scenes

`python -m benchmarks figures all trade --quality paper` makes these tables, the figure and the data that
`halfspace-sss trade` shows.
The bunny is 37 mm tall; the spikes, a ball with bumps and thorns, are about as large across. The small light stands
behind the object: the camera sees transmitted light. `path_traced` alone are walks with sampled light.

| term | meaning |
|---|---|
| bias | relative error of radiance, RMS over visible points and channels, without noise, ± standard error |
| < x | bias lost in noise, below x in 95 % of cases |
| cost | variance of a sample times its seconds: the time to a given noise; of denoised walks that to 1 % |
| variance | without the brightest of 10⁴ samples, which filters take better than samples do |
| seconds | of the processor, all cores together, without compilation |
| – | open: {seconds:g} s for a scene and all techniques were too few |

`full_geometry` learnt the bunny but not the spikes, which stand for a new object. Half-space models lack unscattered
light: most of their bias of ketchup. Costs of gathered light are above those of renders, which have
[numbers of low discrepancy](light.md#numbers-of-low-discrepancy).
"""


def trade_table(scenes: Scenes) -> pandas.DataFrame:
    """A row for each scene and way that renders it."""
    import pandas

    rows: list[dict[str, object]] = []
    for (material, shape, light), o in scenes.items():
        for w in o.ways:
            if w.refusal:
                continue
            row: dict[str, object] = {
                "material": material,
                "shape": shape,
                "light": light,
                "way": w.way,
                "bias": w.bias,
            }
            row |= {"bias_standard_error": w.bias_error, "bias2": w.bias2, "bias2_standard_error": w.bias2_error}
            row["variance"] = w.variance
            row |= {"seconds_per_million": 1e6 * w.seconds, "cost": 1e6 * w.cost}
            rows.append(row)
    return pandas.DataFrame(rows)


def markdown(scenes: Scenes, seconds: float) -> str:
    """What is recommended, the bias of every way, and its cost; `seconds` is what each scene had."""
    lines = [INTRODUCTION.format(seconds=seconds), "## The cheapest technique within a tolerance", ""]
    lines += ["For images of 512 x 512 pixels; in brackets seconds of all cores for all images, training included.", ""]
    lines.append("| material | shape | light | " + " | ".join(_job(*job) for job in JOBS) + " |")
    lines.append("|---|---|---|" + "---|" * len(JOBS))
    for scene, o in scenes.items():
        told = []
        for tolerance, images in JOBS:
            option = advise(Assessment((o,), 0.0, 0.0, 0), Job(tolerance, images)).objects[0].options[0]
            told.append(f"{option.way} ({short(option.seconds)})")
        lines.append(f"| {' | '.join(scene)} | {' | '.join(told)} |")
    lines += ["", "## Bias", "", "In %. Denoised walks have none that more samples leave.", ""]
    lines += _grid(scenes, lambda w, _: w.told_bias, lambda w: not Technique.of(w.way).denoised)
    lines += [
        "",
        "## Cost",
        "",
        "Time to 1 % of noise over the time that `path_traced` takes.",
        "",
    ]
    lines += _grid(scenes, lambda w, o: f"{w.cost / o.traced.cost:.2g}")
    return "\n".join(lines) + "\n"


def _job(tolerance: float, images: int) -> str:
    return f"{100 * tolerance:g} %" + (f", {images} images" if images > 1 else "")


def _grid(
    scenes: Scenes, cell: Callable[[TechniqueTrade, ObjectTrade], str],
    shown: Callable[[TechniqueTrade], bool] = lambda w: True,
) -> list[str]:  # fmt: skip
    """A row for each technique that is shown but plain walks, of each material; a column for each shape and light."""
    columns = list(dict.fromkeys(key[1:] for key in scenes))
    lines = ["| | " + " | ".join(map(", ".join, columns)) + " |", "|---|" + "---:|" * len(columns)]
    for material in dict.fromkeys(key[0] for key in scenes):
        mine = [scenes.get((material, *column)) for column in columns]
        names = dict.fromkeys(
            w.way for o in mine if o for w in o.ways if not w.refusal and w.way != PATH_TRACED and shown(w)
        )
        for name in names:
            rows = [next((w for w in o.ways if w.way == name and not w.refusal), None) if o else None for o in mine]
            cells = ["–" if w is None or o is None else cell(w, o) for w, o in zip(rows, mine)]
            lines.append(f"| {material}: {name} | {' | '.join(cells)} |")
    return lines
