"""Speed against accuracy: each way as a point, total error over time, and the table of every way on every scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures.computing.images import Shot, compared
from figures.drawing.page import page
from figures.drawing.style import TEXT, TRACED, Look, look, paper, saved
from full_geometry.trade.advice import Job, advise
from full_geometry.trade.images import TradePicture
from full_geometry.trade.results import Assessment, ObjectTrade, WayTrade
from full_geometry.trade.ways import GATHERED, NO_SINGLE
from halfspace_sss.noise_free import short

if TYPE_CHECKING:
    import pandas


NOISE = 0.01  # of the mean radiance, to which times are
LEAST = 0.003  # smallest bias that is drawn; what is below lies there, an arrow down
MARKERS = {"full_geometry": "P", "neural_shape": "X", "neural": "D", "neural_material": "d", TRACED: "*"}


def render(picture: TradePicture) -> dict[str, bytes]:
    """{"pdf", "png", "html"}: the figure, and the page to flip between the images of the ways."""
    files: dict[str, bytes] = {}
    shown = [o for o in picture.found.objects if len(o.ways) > 1 and not o.is_dark]
    if shown:
        with paper():
            files = saved(draw(shown, picture.tolerance))
    if picture.images:
        files["html"] = _page(picture).encode()
    return files


def draw(objects: Sequence[ObjectTrade], tolerance: float) -> Figure:
    """A row of two panels for each object, and the legend below."""
    figure = Figure(figsize=(TEXT, 2.5 * len(objects) + 0.75), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03, wspace=0.03)
    grid = figure.subplots(len(objects), 2, squeeze=False)
    handles: dict[str, object] = {}
    for each, (left, right) in zip(objects, grid):
        handles |= trade_panels(each, left, right, tolerance)
        left.set_title(f"{each.object}: {_mfp(each)} mean free paths across", pad=3)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _mfp(assessed: ObjectTrade) -> str:
    low, high = (f"{v:.3g}" for v in assessed.mfp)
    return low if low == high else f"{low} to {high}"


def trade_panels(assessed: ObjectTrade, left: Axes, right: Axes, tolerance: float) -> dict[str, object]:
    """Draw an object; the handles of the legend by label."""
    rows = [w for w in assessed.ways if not w.refusal and w.variance > 0]
    handles = _pareto(left, rows, assessed.pixels, tolerance)
    _over_time(right, rows, assessed.pixels, tolerance)
    return handles


def _look(way: str) -> Look:
    model, *more = way.split(", ")
    style = look(model)
    words = ["no single" if part == NO_SINGLE else part for part in more]
    return style._replace(label=", ".join([style.label, *words]))


def _time(row: WayTrade, pixels: float) -> float:
    return row.time_to(NOISE) * pixels


def _pareto(
    ax: Axes, rows: Sequence[WayTrade], pixels: float, tolerance: float, small: bool = False
) -> dict[str, object]:
    """Bias over the time to a given noise; the front of what nothing beats in both."""
    handles: dict[str, object] = {}
    for row in rows:
        style, x, exact = _look(row.way), _time(row, pixels), row.way == TRACED
        y = LEAST if exact else max(row.bias, LEAST)
        bare = row.way.endswith(NO_SINGLE)
        mark = "s" if row.way.endswith(GATHERED) else MARKERS.get(row.way, "o")
        size = (9 if exact else 5) * (0.7 if small else 1)
        (handle,) = ax.plot(
            x, y, mark, color=style.color, mfc="white" if bare else style.color, ms=size, mew=0.7 if small else 0.9,
            ls="none", zorder=3, clip_on=False, label=style.label,
        )  # fmt: skip
        handles[style.label] = handle
        if not exact:
            low, high = _interval(row)
            ax.plot([x, x], [max(low, LEAST), max(high, LEAST)], color=style.color, lw=0.8, zorder=2)
    _front(ax, [(_time(w, pixels), 0.0 if w.way == TRACED else w.bias) for w in rows])
    ax.axhline(tolerance, color="0.55", lw=0.6, ls=(0, (4, 3)), zorder=0)
    ax.set(xscale="log", yscale="log", xlabel=f"time to {100 * NOISE:g} % noise [s]", ylabel="bias of radiance")
    top = max([w.bias_bound for w in rows if w.way != TRACED], default=1.0)
    ax.set_ylim(LEAST, max(1.6 * top, 3 * tolerance))
    if not small:
        asked = {"ha": "right", "va": "bottom", "size": 6.5, "color": "0.4"}
        ax.text(0.99, tolerance, "asked", transform=ax.get_yaxis_transform(), **asked)
        ax.text(0.99, 0.02, f"exact, or below {100 * LEAST:g} %", transform=ax.transAxes, **asked)
    xs = [_time(w, pixels) for w in rows]
    ax.set_xlim(min(xs) / 2, max(xs) * 4)
    _plain(ax)
    return handles


def _interval(row: WayTrade) -> tuple[float, float]:
    """Bias within one standard error of its square."""
    low, high = row.bias2 - row.bias2_error, row.bias2 + row.bias2_error
    return math.sqrt(max(low, 0.0)), math.sqrt(max(high, 0.0))


def _front(ax: Axes, points: list[tuple[float, float]]) -> None:
    """The staircase of points that nothing beats in time and bias."""
    best, steps = math.inf, []
    for x, y in sorted(points):
        if y < best:
            steps.append((x, max(y, LEAST)))
            best = y
    xs, ys = zip(*steps)
    ax.step([*xs, 1e3 * xs[-1]], [*ys, ys[-1]], where="post", color="0.8", lw=2.5, zorder=1, scalex=False)


def _over_time(ax: Axes, rows: Sequence[WayTrade], pixels: float, tolerance: float) -> None:
    """Total error over time, and where path tracing overtakes."""
    traced = next(w for w in rows if w.way == TRACED)
    middle = traced.variance * traced.seconds * pixels / tolerance**2
    times = np.geomspace(middle / 300, middle * 30, 200)
    for row in (w for w in rows if not w.way.endswith(NO_SINGLE)):
        style = _look(row.way)
        floor, slope = (0.0 if row is traced else row.bias**2), row.variance * row.seconds * pixels
        width = 1.6 if row is traced else 1.0
        ax.plot(times, np.sqrt(floor + slope / times), color=style.color, ls=style.dash, lw=width)
        crossing = (traced.variance * traced.seconds * pixels - slope) / floor if floor > 0 else 0.0
        if times[0] < crossing < times[-1]:
            ax.plot(crossing, math.sqrt(traced.variance * traced.seconds * pixels / crossing), "o", ms=3.2,
                    mfc="white", mec=style.color, mew=0.9, zorder=4)  # fmt: skip
    ax.axhline(tolerance, color="0.55", lw=0.6, ls=(0, (4, 3)), zorder=0)
    ax.set(xscale="log", yscale="log", xlabel="time of an image [s]", ylabel="total error")
    ax.set_xlim(times[0], times[-1])
    ax.set_ylim(tolerance / 6, min(tolerance * 20, 4.0))
    ax.set_title("circles: path tracing overtakes", pad=3)
    _plain(ax)


def _plain(ax: Axes) -> None:
    """Percent on the axis of errors."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: rf"{100 * v:.4g} %"))
    ax.yaxis.set_minor_formatter(NullFormatter())


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
            handles |= _pareto(ax, rows, o.pixels, tolerance, small=True)
            ax.set_title(f"{material}: {_mfp(o)} mfp", pad=2, size=7)
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
    xs = [_time(w, o.pixels) for o in objects for w in o.ways if not w.refusal and w.variance > 0]
    ax.set_xlim(min(xs) / 2, max(xs) * 3)


def image_shots(images: Mapping[str, np.ndarray], assessment: Assessment) -> list[Shot]:
    """The images of all ways, path traced first, with FLIP and what each costs."""
    reference = images[TRACED]
    exposure = _exposure(reference)
    numbers = {w.way: w for o in assessment.objects for w in o.ways}
    shots = [Shot(_look(TRACED).label, reference, _numbers(numbers[TRACED]))]
    for name, image in images.items():
        if name != TRACED:
            told = _numbers(numbers[name])
            shots.append(compared(_look(name).label, image, reference, exposure=exposure, numbers=told))
    return shots


def _exposure(reference: np.ndarray) -> float:
    bright = float(np.percentile(reference, 99.0))
    return math.log2(0.9 / bright) if bright > 0 else 0.0


def _page(picture: TradePicture) -> str:
    shots = image_shots(picture.images, picture.found)
    caption = picture.sentences[0] if picture.sentences else ""
    return page(picture.title, {picture.title: shots}, exposure=_exposure(picture.images[TRACED]), caption=caption)


def _numbers(row: WayTrade) -> dict[str, float | str]:
    return {"bias, %": row.told_bias, "variance": f"{row.variance:.3g}", "s a million": f"{1e6 * row.seconds:.3g}"}


Scenes = Mapping[tuple[str, str, str], ObjectTrade]
JOBS = ((0.02, 1), (0.05, 1), (0.05, 100), (0.1, 1), (0.2, 1))  # tolerance, images
INTRODUCTION = """\
# Speed against accuracy on scenes

`halfspace-sss figures all trade` makes this page, the figure, its data (shown by `halfspace-sss trade`) and the page
to flip between the images. The bunny is 37 mm tall; the spikes, a ball with bumps and thorns, are about as large
across. The small light stands behind the object: what the camera sees of it was transmitted.

| term | meaning |
|---|---|
| bias | relative error of radiance at any number of samples, noise of both sides subtracted, ± standard error |
| points | root mean square over visible points and channels |
| fireflies | the brightest of 10⁴ samples; in biases what they carry is spread over the object |
| < x | bias lost in noise, below x in 95 % of cases |
| cost | variance of a sample times its seconds: the time to a given noise |
| seconds | of the processor, all cores together, without compilation |
| variance | without the brightest of 10⁴ samples, as filters take fireflies better than samples do |

What cannot be told in {seconds:g} s for a scene and all ways is left open. `full_geometry` learnt the bunny but not
the spikes, which stand for a new object. Unscattered light is in the walks and not in the half-space models: most of
their bias of ketchup.
"""
KNOBS = """\
Bunny, small light; cost over that of the usual setting, error where the setting has one.

| knob | meaning |
|---|---|
| entries | parameter of `bssrdf` |
| channels in one walk | no setting: the cost of a walk for each channel, which one walk for all saves |
| nodes | `n_samples` of photon beam diffusion: time of S alone, error against walks of the half-space |
| precision | of a network, measured as nodes; no setting: single precision, on CUDA half |
"""


def trade_table(scenes: Scenes) -> pandas.DataFrame:
    """A row for each scene and way that renders it."""
    import pandas

    rows: list[dict[str, Any]] = []
    for (material, shape, light), o in scenes.items():
        for w in o.ways:
            if w.refusal:
                continue
            row: dict[str, Any] = {"material": material, "shape": shape, "light": light, "way": w.way, "bias": w.bias}
            row |= {"bias_standard_error": w.bias_error, "bias2": w.bias2, "bias2_standard_error": w.bias2_error}
            row["variance"] = w.variance
            row |= {"seconds_per_million": 1e6 * w.seconds, "cost": 1e6 * w.seconds * w.variance}
            rows.append(row | {"flip": w.flip, "flip_noise": w.flip_noise})
    return pandas.DataFrame(rows)


def markdown(scenes: Scenes, seconds: float, settings: Sequence[Mapping[str, Any]] = ()) -> str:
    """What is recommended, the bias of every way, and its cost; `seconds` is what each scene had."""
    lines = [INTRODUCTION.format(seconds=seconds), "## The cheapest way that keeps a tolerance", ""]
    lines += ["For images of 512 x 512 pixels; in brackets seconds of all cores for all of them, training counted.", ""]
    lines.append("| material | shape | light | " + " | ".join(_job(*job) for job in JOBS) + " |")
    lines.append("|---|---|---|" + "---|" * len(JOBS))
    for scene, o in scenes.items():
        told = []
        for tolerance, images in JOBS:
            option = advise(Assessment((o,), 0.0, 0.0, 0), Job(tolerance, images)).objects[0].options[0]
            told.append(f"{option.way} ({short(option.seconds)})")
        lines.append(f"| {' | '.join(scene)} | {' | '.join(told)} |")
    lines += ["", "## Bias", "", "Relative error of radiance over visible points, %.", ""]
    lines += _grid(scenes, lambda w, _: w.told_bias)
    lines += [
        "",
        "## Cost",
        "",
        "Variance of a sample times seconds of a million samples, over that of path tracing.",
        "",
    ]
    lines += _grid(scenes, lambda w, o: f"{w.variance * w.seconds / (o.traced.variance * o.traced.seconds):.2g}")
    if settings:
        lines += ["", "## Knobs", "", KNOBS]
        lines += ["| material | knob | setting | way | cost | error, % |", "|---|---|---:|---|---:|---:|"]
        for s in settings:
            words = " | ".join(str(s[key]) for key in ("material", "knob", "value", "way"))
            error = short(100 * s["error"]) if s["knob"] in ("nodes", "precision") else "–"  # the others change none
            lines.append(f"| {words} | {short(s['cost'])} | {error} |")
    return "\n".join(lines) + "\n"


def _job(tolerance: float, images: int) -> str:
    return f"{100 * tolerance:g} %" + (f", {images} images" if images > 1 else "")


def _grid(scenes: Scenes, cell: Any) -> list[str]:
    """A row for each way, a column for each scene of a material, a table for each material."""
    lines: list[str] = []
    for material in dict.fromkeys(key[0] for key in scenes):
        mine = {key: o for key, o in scenes.items() if key[0] == material}
        lines.append(f"| {material} | " + " | ".join(f"{shape}, {light}" for _, shape, light in mine) + " |")
        lines.append("|---|" + "---:|" * len(mine))
        names = dict.fromkeys(w.way for o in mine.values() for w in o.ways if not w.refusal)
        for name in names:
            rows = [next((w for w in o.ways if w.way == name and not w.refusal), None) for o in mine.values()]
            cells = ["–" if w is None else cell(w, o) for w, o in zip(rows, mine.values())]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        lines.append("")
    return lines[:-1]
