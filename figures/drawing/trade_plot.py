"""Speed against accuracy: each way as a point, total error over time, and the table of every way on every scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures.computing.images import Shot, compared
from figures.drawing.page import page
from full_geometry.trade.images import TradePicture
from full_geometry.trade.results import NOISE, Assessment, ObjectTrade, TechniqueTrade
from full_geometry.trade.techniques import CORRECTED, GATHERED
from halfspace_sss.comparison.style import TEXT, TRACED, Look, look, paper, saved

LEAST = 0.003  # smallest bias that is drawn; what is below lies there, an arrow down
MARKERS = {"full_geometry": "P", "neural_shape": "X", "neural": "D", "neural_material": "d"}
MARKERS |= {
    TRACED: "*",
    f"{TRACED}, precomputed": "h",
    f"{TRACED}, denoised": "<",
    f"{TRACED}, precomputed, denoised": ">",
}


def render(picture: TradePicture) -> dict[str, bytes]:
    """{"pdf", "png", "html"}: the figure, and the page to flip between the images of the ways."""
    files: dict[str, bytes] = {}
    shown = [o for o in picture.found.objects if len(o.ways) > 1 and not o.is_dark]
    if shown:
        with paper():
            files = saved(draw(shown, picture.tolerance))
    if picture.images:
        caption, shots = picture.sentences[0] if picture.sentences else "", image_shots(picture.images, picture.found)
        exposure = _exposure(picture.images[TRACED])
        files["html"] = page(picture.title, {picture.title: shots}, exposure=exposure, caption=caption).encode()
    return files


def draw(objects: Sequence[ObjectTrade], tolerance: float) -> Figure:
    """A row of two panels for each object, and the legend below."""
    figure = Figure(figsize=(TEXT, 2.5 * len(objects) + 0.75), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03, wspace=0.03)
    grid = figure.subplots(len(objects), 2, squeeze=False)
    handles: dict[str, object] = {}
    for each, (left, right) in zip(objects, grid):
        rows = [w for w in each.ways if not w.refusal and w.variance > 0]
        handles |= pareto(left, rows, each.pixels, tolerance)
        _overtime_to_noise(right, rows, each.pixels, tolerance)
        left.set_title(f"{each.object}: {span_in_mfp(each)} mean free paths across", pad=3)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def span_in_mfp(assessed: ObjectTrade) -> str:
    """Mean free paths across an object, of all channels."""
    low, high = (f"{v:.3g}" for v in assessed.mfp)
    return low if low == high else f"{low} to {high}"


def _look(way: str) -> Look:
    model, *more = way.split(", ")
    style = look(model)
    return style._replace(label=", ".join([style.label, *more]))


def time_to_noise(row: TechniqueTrade, pixels: float) -> float:
    """Seconds after which an image has the noise `NOISE`."""
    return row.time_to(NOISE) * pixels


def pareto(
    ax: Axes, rows: Sequence[TechniqueTrade], pixels: float, tolerance: float, small: bool = False
) -> dict[str, object]:
    """Bias over the time to a given noise; the front of what nothing beats in both."""
    handles: dict[str, object] = {}
    for row in rows:
        style, x, exact = _look(row.way), time_to_noise(row, pixels), row.way == TRACED
        y = LEAST if exact else max(row.bias, LEAST)
        mark = {GATHERED: "s", CORRECTED: "^"}.get(row.way.rpartition(", ")[2]) or MARKERS.get(row.way, "o")
        size = (9 if exact else 5) * (0.7 if small else 1)
        (handle,) = ax.plot(
            x, y, mark, color=style.color, mfc=style.color, ms=size, mew=0.7 if small else 0.9,
            ls="none", zorder=3, clip_on=False, label=style.label,
        )  # fmt: skip
        handles[style.label] = handle
        if not exact:
            ends = [max(math.sqrt(max(row.bias2 + s * row.bias2_error, 0.0)), LEAST) for s in (-1, 1)]
            ax.plot([x, x], ends, color=style.color, lw=0.8, zorder=2)
    _front(ax, [(time_to_noise(w, pixels), 0.0 if w.way == TRACED else w.bias) for w in rows])
    ax.axhline(tolerance, color="0.55", lw=0.6, ls=(0, (4, 3)), zorder=0)
    ax.set(xscale="log", yscale="log", xlabel=f"time to {100 * NOISE:g} % noise [s]", ylabel="bias of radiance")
    top = max([w.bias_bound for w in rows if w.way != TRACED], default=1.0)
    ax.set_ylim(LEAST, max(1.6 * top, 3 * tolerance))
    if not small:
        asked = {"ha": "right", "va": "bottom", "size": 6.5, "color": "0.4"}
        ax.text(0.99, tolerance, "asked", transform=ax.get_yaxis_transform(), **asked)
        ax.text(0.99, 0.02, f"exact, or below {100 * LEAST:g} %", transform=ax.transAxes, **asked)
    xs = [time_to_noise(w, pixels) for w in rows]
    ax.set_xlim(min(xs) / 2, max(xs) * 4)
    _plain(ax)
    return handles


def _front(ax: Axes, points: list[tuple[float, float]]) -> None:
    """The staircase of points that nothing beats in time and bias."""
    best, steps = math.inf, []
    for x, y in sorted(points):
        if y < best:
            steps.append((x, max(y, LEAST)))
            best = y
    xs, ys = zip(*steps)
    ax.step([*xs, 1e3 * xs[-1]], [*ys, ys[-1]], where="post", color="0.8", lw=2.5, zorder=1, scalex=False)


def _overtime_to_noise(ax: Axes, rows: Sequence[TechniqueTrade], pixels: float, tolerance: float) -> None:
    """Total error over time, and where path tracing overtakes."""
    traced = next(w for w in rows if w.way == TRACED)
    middle = traced.variance * traced.seconds * pixels / tolerance**2
    times = np.geomspace(middle / 300, middle * 30, 200)
    for row in rows:
        style = _look(row.way)
        error, width = np.sqrt(row.bias**2 + row.noise2(times / (row.seconds * pixels))), 1.6 if row is traced else 1.0
        ax.plot(times, error, color=style.color, ls=style.dash, lw=width)
        overtaken = int(np.argmax(np.sqrt(traced.noise2(times / (traced.seconds * pixels))) < error))
        if overtaken:
            ax.plot(times[overtaken], error[overtaken], "o", ms=3.2, mfc="white", mec=style.color, mew=0.9, zorder=4)
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


def _numbers(row: TechniqueTrade) -> dict[str, float | str]:
    return {"bias, %": row.told_bias, "variance": f"{row.variance:.3g}", "s a million": f"{1e6 * row.seconds:.3g}"}
