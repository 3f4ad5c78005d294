"""Reflectance curves of a path tracer and of models, their errors, and the files that hold them."""

from __future__ import annotations

import base64
import io
import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.backend import BackendError
from halfspace_sss.comparison.style import TEXT, TRACED, look, paper, saved
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import JsonDict, check_folder, provenance, write_together

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNITS = {
    "theta_i_deg": "degree, w_i from the normal",
    "theta_o_deg": "degree, w_o from the normal",
    "delta_phi_deg": "degree, azimuth of w_o from the forward direction of the plane of incidence",
    "line_deg": "degree, azimuth of x_o - x_i from the forward direction",
    "r_mm": "mm, geometric middle of the cell",
    "S": "1/(mm2 sr), mean over the cell of r and azimuth",
    "S_at_r": "1/(mm2 sr), at the middle of the cell; path traced: the mean again",
    "standard_error": "1/(mm2 sr), Monte Carlo; 0 for models",
    "L1": "sum |S - S_traced| area / sum S_traced area, cells of the range",
    "bias": "sum (S - S_traced) area / sum S_traced area, cells of the range",
    "noise": "expected L1 of the path-traced curve against the truth",
    "bias_standard_error": "Monte Carlo standard error of bias",
    "reflectance": "fraction of incident flux at reflectance_orders",
    "evaluations_per_s": "evaluations of S per second, NumPy, float64",
}


@dataclass(frozen=True)
class Curve:
    """One series in one direction of incidence.

    Args:
        series: name of the model, or "path_traced".
        orders: scattering orders it contains; "multiple" for the path-traced curve.
        theta_i_deg: angle of incidence, degrees.
        S: mean of S over each cell, 1/(mm² sr).
        S_at_r: S at the middle of each cell, 1/(mm² sr); the mean again for the path-traced curve.
        standard_error: Monte Carlo standard error of S, 0 for a model.
        reflectance: order -> (fraction of incident flux, Monte Carlo standard error), at the orders that were asked.
    """

    series: str
    orders: str
    theta_i_deg: float
    S: np.ndarray
    S_at_r: np.ndarray
    standard_error: np.ndarray
    reflectance: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, repr=False)
class CurveSet:
    """What `curves` measured: S along a line for several directions of incidence, path traced and by models.

    Off the line where the two refracted rays meet, the single order of a pencil beam has no radiance: the orders
    "multiple" and "total" have the same curve, so that models of either are compared with the one path-traced curve.

    Attributes:
        title, medium: what it is of; medium is scalar.
        theta_o_deg, delta_phi_deg, line_deg: direction of observation and of the line, degrees.
        half_width: half the angle about the line that a cell spans, radians.
        orders: "multiple", where reflectances are of each model's own orders, or "total".
        r_edges: edges of the cells, mm.
        curves: for each direction of incidence the path-traced curve, then the models.
        evaluations_per_s: by model, evaluations of S per second in NumPy, float64.
        n_paths: walks per direction of incidence. seed, backend: of the tracer. seconds: spent in tracing.
        notes: what was left out, and why.
    """

    title: str
    medium: Medium
    theta_o_deg: float
    delta_phi_deg: float
    line_deg: float
    half_width: float
    orders: str
    r_edges: np.ndarray
    curves: tuple[Curve, ...]
    evaluations_per_s: Mapping[str, float]
    n_paths: int
    seed: int
    backend: str
    seconds: float
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        angles = ", ".join(f"{theta:g}" for theta in self.theta_i_deg)
        r = f"r {self.r_edges[0]:.3g} to {self.r_edges[-1]:.3g} mm"
        return f"<CurveSet of {', '.join(self.series)}; theta_i {angles} degrees, {r}; {self.medium}>"

    def _repr_html_(self) -> str:
        columns = ["theta_i_deg", "series", "r_from_mm", "r_to_mm", "L1", "noise", "bias", "bias_standard_error"]
        table = self.errors()[columns].to_html(index=False, float_format="{:.3g}".format)
        return f"<p>{escape(repr(self).strip('<>'))}</p>{self._drawn()}{table}"

    def _drawn(self) -> str:
        """The plot as a page shows it; nothing without matplotlib."""
        if not _can_draw():
            return ""
        file = io.BytesIO()
        self.plot().savefig(file, format="png")
        return f'<img src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'

    def plot(self) -> Figure:
        """A `matplotlib.figure.Figure`: S over r for each direction of incidence, and its ratio to the traced curve.

        Raises:
            BackendError: matplotlib is not installed.
        """
        if not _can_draw():
            raise BackendError('plot needs matplotlib: pip install "halfspace-sss[figures]"')
        return draw(self)

    @property
    def r(self) -> np.ndarray:
        """Geometric middle of each cell, mm."""
        return np.sqrt(self.r_edges[:-1] * self.r_edges[1:])

    @property
    def theta_i_deg(self) -> tuple[float, ...]:
        """Angles of incidence, degrees."""
        return tuple(dict.fromkeys(c.theta_i_deg for c in self.curves))

    @property
    def series(self) -> tuple[str, ...]:
        """Names of the series, "path_traced" first if it was traced."""
        return tuple(dict.fromkeys(c.series for c in self.curves))

    def curve(self, series: str, theta_i_deg: float) -> Curve:
        """The curve of one series and direction; ValueError if there is none."""
        for c in self.curves:
            if (c.series, c.theta_i_deg) == (series, theta_i_deg):
                return c
        raise ValueError(
            f"series, theta_i_deg must be of {self.series}, {self.theta_i_deg}, got {(series, theta_i_deg)!r}"
        )

    def to_dataframe(self) -> pandas.DataFrame:
        """One row per direction, series and distance: where, r_mm, series, orders, S, S_at_r, standard_error."""
        import pandas

        parts = [
            pandas.DataFrame({
                "theta_i_deg": c.theta_i_deg, "theta_o_deg": self.theta_o_deg, "delta_phi_deg": self.delta_phi_deg,
                "line_deg": self.line_deg, "r_mm": self.r, "series": c.series, "orders": c.orders,
                "S": c.S, "S_at_r": c.S_at_r, "standard_error": c.standard_error,
            })
            for c in self.curves
        ]  # fmt: skip
        return pandas.concat(parts, ignore_index=True)

    def to_xarray(self) -> xarray.Dataset:
        """S, S_at_r and standard_error over `theta_i_deg`, `series` and `r_mm`; NaN where a series has none."""
        values = ["S", "S_at_r", "standard_error"]
        keys = ["theta_i_deg", "series", "r_mm"]
        return self.to_dataframe().set_index(keys)[values].to_xarray()

    def errors(self) -> pandas.DataFrame:
        """Error of every model per decade of r and over all, with reflectance and speed; one row each.

        L1 = sum |S - S_t| A / sum S_t A and bias = sum (S - S_t) A / sum S_t A over the cells of a range, where S_t
        is path traced and A = r_out² - r_in² weights by energy; a cell belongs to the decade of its middle. `noise`
        is the L1 that Monte Carlo noise alone gives, and `bias_standard_error` what it does to the bias, with cells
        taken as independent. The row of the path-traced series has L1 = noise. NaN where no light was traced.
        """
        import pandas

        rows, is_traced = [], TRACED in self.series
        for c in self.curves:
            traced = self.curve(TRACED, c.theta_i_deg) if is_traced else None
            order = "total" if "total" in (self.orders, c.orders) else "multiple"
            R, R_error = c.reflectance[order]
            R_t, R_t_error = traced.reflectance[order] if traced else (math.nan, math.nan)
            common = {"reflectance_orders": order, "reflectance": R, "reflectance_traced": R_t}
            common |= {"reflectance_standard_error": R_error, "reflectance_traced_standard_error": R_t_error}
            common["evaluations_per_s"] = self.evaluations_per_s.get(c.series, math.nan)
            edges = range_edges(self.r_edges)
            ranges = [(edges[0], edges[-1]), *zip(edges[:-1], edges[1:])] if len(edges) > 2 else [tuple(edges)]
            for low, high in ranges:
                row = {"theta_i_deg": c.theta_i_deg, "series": c.series, "orders": c.orders}
                row |= {"r_from_mm": low, "r_to_mm": high, **self._error(c, traced, low, high)}
                rows.append(row | common)
        return pandas.DataFrame(rows)

    def _error(self, c: Curve, traced: Curve | None, low: float, high: float) -> dict[str, float]:
        if traced is None:
            return dict.fromkeys(("L1", "bias", "noise", "bias_standard_error"), math.nan)
        inside = (self.r >= low) & (self.r <= high)
        area = np.diff(self.r_edges**2)[inside]
        S_t, error = traced.S[inside] * area, traced.standard_error[inside] * area
        flux = S_t.sum()
        if not flux > 0:
            return dict.fromkeys(("L1", "bias", "noise", "bias_standard_error"), math.nan)
        gap, noise = c.S[inside] * area - S_t, math.sqrt(2 / math.pi) * error.sum() / flux
        L1 = noise if c is traced else np.abs(gap).sum() / flux
        spread = math.sqrt((error**2).sum()) / flux
        return {"L1": L1, "bias": gap.sum() / flux, "noise": noise, "bias_standard_error": spread}

    def parameters(self) -> JsonDict:
        """Everything that defines the result, ready for JSON."""
        medium = {name: getattr(self.medium, name) for name in ("sigma_s", "sigma_a", "g", "eta", "sigma_t", "albedo")}
        names = ("title", "theta_i_deg", "theta_o_deg", "delta_phi_deg", "line_deg", "half_width", "orders", "series")
        about = {"medium": medium, **{name: getattr(self, name) for name in names}, "r_edges_mm": self.r_edges.tolist()}
        return about | {"n_paths": self.n_paths, "seed": self.seed, "backend": self.backend}

    def save(self, folder: str | Path, name: str = "curves") -> list[Path]:
        """Write NAME.csv (every series), NAME_errors.csv, NAME.json (provenance) and the figure as NAME.pdf and .png.

        Files of those names are replaced, all or none. Without matplotlib there is no figure, and if it cannot be drawn
        a warning says why; the numbers are written all the same.

        Returns:
            The paths that were written.

        Raises:
            ValueError: folder exists and is a file.
        """
        folder = check_folder(folder)
        content: dict[str, bytes | str] = dict(self.tables(name))
        try:
            figures = self._figures()
        except BaseException:  # an interrupt while it was drawn
            self._write(folder, name, content)
            raise
        return self._write(folder, name, content | {f"{name}.{ending}": data for ending, data in figures.items()})

    def tables(self, name: str = "curves") -> dict[str, str]:
        """NAME.csv, of every series, and NAME_errors.csv."""
        results = {f"{name}.csv": self.to_dataframe(), f"{name}_errors.csv": self.errors()}
        return {file: table.to_csv(index=False, lineterminator="\n") for file, table in results.items()}

    def _figures(self) -> dict[str, bytes]:
        """The figure by file ending; none, with a warning, if it cannot be drawn."""
        if not _can_draw():
            return {}
        try:
            return render(self)
        except Exception as error:  # a font, a full memory: the numbers took longer than the figure will
            warnings.warn(f"the figure could not be drawn: {type(error).__name__}: {error}", stacklevel=2)
            return {}

    def _write(self, folder: Path, name: str, content: dict[str, bytes | str]) -> list[Path]:
        about = {**provenance(**self.parameters()), "units": UNITS, "notes": list(self.notes)}
        about |= {"seconds_tracing": self.seconds, "evaluations_per_s": dict(self.evaluations_per_s)}
        content = {**content, f"{name}.json": json.dumps({**about, "files": sorted(content)}, indent=1) + "\n"}
        write_together({folder / file: data for file, data in content.items()})
        return [folder / file for file in content]


def _can_draw() -> bool:
    return find_spec("matplotlib") is not None


def range_edges(r_edges: np.ndarray) -> list[float]:
    """The ends of r_edges and the powers of ten between them."""
    low, high = float(r_edges[0]), float(r_edges[-1])
    powers = [10.0**k for k in range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)]
    return [low, *(p for p in powers if low < p < high), high]


# ---- The figure: small multiples of S over r, and its ratio to the path-traced curve

RATIO_SPAN = 12.0  # the ratio panels show 1/12 to 12 at most; what is beyond lies at the edge of the panel
MOST_COLUMNS = 4


def render(curves: CurveSet) -> dict[str, bytes]:
    """The figure as {"pdf": bytes, "png": bytes}."""
    with paper():
        return saved(draw(curves))


def draw(curves: CurveSet) -> Figure:
    """One column for each direction of incidence: above S(r) with 2 standard errors, below S over path-traced S.
    Without a path-traced curve there is nothing below."""
    from matplotlib.figure import Figure

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


def _models(curves: CurveSet) -> list[str]:
    return [series for series in curves.series if series != TRACED]


def _title(theta: float, k: int) -> str:
    return rf"({chr(97 + k)})  $\theta_i$ = {theta:g}°"


def _caption(curves: CurveSet) -> str:
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


def _limits(curves: CurveSet) -> tuple[float, float]:
    """About the path-traced curves and, up to a factor of 30 above and 10 below, the models."""
    known = [c for c in curves.curves if c.series == TRACED] or curves.curves
    traced = np.concatenate([c.S[c.S > 3 * c.standard_error] for c in known])
    if not traced.size:
        return 1e-6, 1.0
    every = np.concatenate([c.S for c in curves.curves])
    top = min(every.max(), 30 * traced.max())
    bottom = max(every[every > 0].min(), traced.min() / 10)
    return 0.6 * bottom, 1.7 * top


def _draw_radiance(ax: Axes, curves: CurveSet, theta: float) -> None:
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


def _draw_ratio(ax: Axes, curves: CurveSet, theta: float) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter

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
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.xaxis.set_major_locator(LogLocator(10))
    ax.xaxis.set_minor_locator(LogLocator(10, subs=range(2, 10)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.tick_params(which="both", top=True, right=True)


def _legend(figure: Figure, curves: CurveSet, columns: int) -> None:
    from matplotlib.lines import Line2D

    first = curves.curves[0]
    dots = {"color": "k", "lw": 0.7, "marker": "o", "ms": 2.2, "mew": 0}
    handles = [Line2D([], [], label=_label(first), **dots)] if first.series == TRACED else []
    firsts = [curves.curve(s, curves.theta_i_deg[0]) for s in _models(curves)]
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


def _label(c: Curve) -> str:
    """A star marks models that contain single scattering."""
    if c.series == TRACED:
        return r"Path traced ($\pm 2\,\sigma$)"
    return look(c.series).label + ("*" if c.orders == "total" else "")
