"""Draws a set of reflectance curves as small multiples: S over r and its ratio to the path-traced curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter

from halfspace_sss.comparison.style import TEXT, TRACED, look, paper, saved
from halfspace_sss.physics.medium import Medium

RATIO_SPAN = 12.0  # the ratio panels show 1/12 to 12 at most; what is beyond lies at the edge of the panel
MOST_COLUMNS = 4


class PlottedCurve(Protocol):
    """What is drawn of a `curve_set.Curve`."""

    series: str
    orders: str
    S: np.ndarray
    standard_error: np.ndarray


class PlottedCurves(Protocol):
    """What is drawn of a `curve_set.CurveSet`, which draws itself by this module."""

    title: str
    medium: Medium
    theta_o_deg: float
    delta_phi_deg: float
    line_deg: float
    r: np.ndarray
    r_edges: np.ndarray
    theta_i_deg: tuple[float, ...]
    series: tuple[str, ...]
    curves: Sequence[PlottedCurve]

    def curve(self, series: str, theta_i_deg: float) -> PlottedCurve:
        """The curve of one series and direction."""


def render(curves: PlottedCurves) -> dict[str, bytes]:
    """The figure as {"pdf": bytes, "png": bytes}."""
    with paper():
        return saved(draw(curves))


def draw(curves: PlottedCurves) -> Figure:
    """One column for each direction of incidence: above S(r) with 2 standard errors, below S over path-traced S.
    Without a path-traced curve there is nothing below."""
    angles, rows = curves.theta_i_deg, 2 if TRACED in curves.series else 1
    blocks = -(-len(angles) // MOST_COLUMNS)
    columns = -(-len(angles) // blocks)
    legend_rows = -(-len(curves.series) // 4)
    heights, width = [2.0, 1.15][:rows] * blocks, TEXT if columns > 2 else 0.5 * TEXT * max(columns, 1.3)
    figure = Figure(figsize=(width, (1 + rows) * blocks + 0.6 + 0.17 * legend_rows), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.015, h_pad=0.015, wspace=0.0, hspace=0.02)
    grid = figure.subplots(rows * blocks, columns, squeeze=False, sharex=True, sharey="row", height_ratios=heights)
    limits = _limits(curves)
    for k, theta in enumerate(angles):
        block, column = divmod(k, columns)
        above, below = grid[rows * block, column], grid[rows * (block + 1) - 1, column]
        _draw_radiance(above, curves, theta)
        above.set_ylim(*limits)
        above.set_title(_title(theta, k), pad=3)
        if column == 0:
            above.set_ylabel(r"$S$ [mm$^{-2}$ sr$^{-1}$]")
        if rows == 2:
            _draw_ratio(below, curves, theta)
            below.set_ylabel("model / traced" if column == 0 else "")
        below.set_xlabel(r"$r$ [mm]", labelpad=1)
        below.tick_params(labelbottom=True)
    for spare in grid[rows * (blocks - 1) :, len(angles) - columns * (blocks - 1) :].flat:
        spare.set_visible(False)
    _legend(figure, curves, columns)
    figure.suptitle(_caption(curves), fontsize=8)
    return figure


def _models(curves: PlottedCurves) -> list[str]:
    return [series for series in curves.series if series != TRACED]


def _title(theta: float, k: int) -> str:
    return rf"({chr(97 + k)})  $\theta_i$ = {theta:g}°"


def _caption(curves: PlottedCurves) -> str:
    m = curves.medium
    name = f"{curves.title}: " if curves.title else ""
    line = {90.0: "perpendicular to the plane of incidence", 0.0: "in the forward direction"}
    where = line.get(curves.line_deg, f"at {curves.line_deg:g}° from the forward direction")
    azimuth = rf", $\Delta\phi$ = {curves.delta_phi_deg:g}°" if curves.theta_o_deg and curves.delta_phi_deg else ""
    return (
        rf"{name}$\sigma_t = {m.sigma_t:.4g}$ mm$^{{-1}}$, $\alpha = {m.albedo:.4g}$, $g = {m.g:.3g}$, "
        rf"$\eta = {m.eta:.4g}$;  $\theta_o$ = {curves.theta_o_deg:g}°{azimuth};  line {where}"
    )


def _positive(values: np.ndarray) -> np.ndarray:
    return np.where(values > 0, values, np.nan)


def _limits(curves: PlottedCurves) -> tuple[float, float]:
    """About the path-traced curves and, up to a factor of 30 above and 10 below, the models."""
    known = [c for c in curves.curves if c.series == TRACED] or curves.curves
    traced = np.concatenate([c.S[c.S > 3 * c.standard_error] for c in known])
    if not traced.size:
        return 1e-6, 1.0
    every = np.concatenate([c.S for c in curves.curves])
    top = min(every.max(), 30 * traced.max())
    bottom = max(every[every > 0].min(), traced.min() / 10)
    return 0.6 * bottom, 1.7 * top


def _draw_radiance(ax: Axes, curves: PlottedCurves, theta: float) -> None:
    ax.set(xscale="log", yscale="log", xlim=(curves.r_edges[0], curves.r_edges[-1]))
    for series in _models(curves):
        style = look(series)
        ax.plot(curves.r, _positive(curves.curve(series, theta).S), color=style.color, ls=style.dash, zorder=2)
    if TRACED in curves.series:
        traced = curves.curve(TRACED, theta)
        low, high = traced.S - 2 * traced.standard_error, traced.S + 2 * traced.standard_error
        ax.fill_between(curves.r, np.maximum(low, 1e-300), _positive(high), color="0.72", lw=0, zorder=1)
        ax.plot(curves.r, _positive(traced.S), "k-", lw=0.7, marker="o", ms=1.9, mew=0, zorder=3)
    _ticks(ax)


def _draw_ratio(ax: Axes, curves: PlottedCurves, theta: float) -> None:
    traced = curves.curve(TRACED, theta)
    S = _positive(np.where(traced.S > 3 * traced.standard_error, traced.S, np.nan))
    noise = 2 * traced.standard_error / S
    ax.fill_between(curves.r, np.maximum(1 - noise, 1e-3), 1 + noise, color="0.72", lw=0, zorder=1)
    ax.axhline(1, color="k", lw=0.7, zorder=1.5)
    for series in _models(curves):
        style = look(series)
        ax.plot(curves.r, curves.curve(series, theta).S / S, color=style.color, ls=style.dash, zorder=2)
    ax.set(xscale="log", yscale="log", ylim=(1 / RATIO_SPAN, RATIO_SPAN))
    ax.yaxis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1, 2, 5, 10]))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    ax.yaxis.set_minor_locator(FixedLocator([]))
    ax.grid(axis="y", color="0.9", lw=0.4)
    _ticks(ax)


def _ticks(ax: Axes) -> None:
    ax.xaxis.set_major_locator(LogLocator(10))
    ax.xaxis.set_minor_locator(LogLocator(10, subs=range(2, 10)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.tick_params(which="both", top=True, right=True)


def _legend(figure: Figure, curves: PlottedCurves, columns: int) -> None:
    from matplotlib.lines import Line2D

    first = curves.curves[0]
    dots = {"color": "k", "lw": 0.7, "marker": "o", "ms": 2.2, "mew": 0}
    handles = [Line2D([], [], label=_label(first), **dots)] if first.series == TRACED else []
    firsts: Sequence[PlottedCurve] = [curves.curve(s, curves.theta_i_deg[0]) for s in _models(curves)]
    for c in firsts:
        style = look(c.series)
        handles.append(Line2D([], [], color=style.color, ls=style.dash, label=_label(c)))
    starred = any(c.orders == "total" for c in firsts)
    figure.legend(
        title="* contains single scattering, which the path-traced curve lacks" if starred else None,
        title_fontsize=7,
        handles=handles, loc="outside lower center", ncols=4 if columns > 2 else 2, frameon=False,
        handlelength=2.8, columnspacing=1.4, borderaxespad=0.1,
    )  # fmt: skip


def _label(c: PlottedCurve) -> str:
    """A star marks models that contain single scattering."""
    if c.series == TRACED:
        return r"Path traced ($\pm 2\,\sigma$)"
    return look(c.series).label + ("*" if c.orders == "total" else "")
