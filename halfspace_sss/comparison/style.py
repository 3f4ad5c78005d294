"""What all figures share: fonts, widths and the look of each series, distinguishable without colour and in grey."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMN, TEXT = 3.35, 7.0  # widths of a column and of the text block, inches
TRACED = "path_traced"


class Look(NamedTuple):
    """Label, colour and dash pattern of a series."""

    label: str
    color: str
    dash: str | tuple[float, tuple[float, ...]]


# Okabe and Ito's colours, which stay apart in the common kinds of colour blindness; relatives share a hue family
_LOOKS = {
    TRACED: Look("Path traced", "#000000", "-"),
    "standard_dipole": Look("Standard dipole", "#0072B2", (0, (5, 1.6))),
    "standard_dipole_normalized": Look("Standard dipole, normalized", "#56B4E9", (0, (5, 1.4, 1, 1.4))),
    "better_dipole": Look("Better dipole", "#009E73", (0, (2.6, 1.2))),
    "directional_dipole": Look("Directional dipole", "#D55E00", (0, (1.1, 1.1))),
    "photon_beam_diffusion": Look("Photon beam diffusion", "#CC79A7", "-"),
    "normalized_diffusion": Look("Normalized diffusion", "#E69F00", (0, (7, 1.5, 1, 1.5, 1, 1.5))),
    "forward_scattering_dipole": Look("Forward-scattering dipole", "#7B3294", (0, (8, 1.8))),
    "neural": Look("Neural", "#C00000", "-"),
    "full_geometry": Look("Full geometry", "#004D40", "-"),
    "lambert": Look("Lambert", "#8C8C8C", (0, (1, 1.2))),
    "neural_shape": Look("Neural, any shape", "#E6007E", (0, (4, 1))),
    "neural_material": Look("Neural, one material", "#7A5C00", (0, (3, 1, 1, 1))),
}
_SPARE = ("#8C6D31", "#5F5F5F", "#17806D", "#A6761D", "#3B528B")


def look(series: str) -> Look:
    """The look of a series; one that is not in the list gets a colour by its name, the same in every figure."""
    if series in _LOOKS:
        return _LOOKS[series]
    label = series.replace("_", " ").capitalize()
    return Look(label, _SPARE[sum(series.encode()) % len(_SPARE)], (0, (3, 1, 1, 1)))


@contextmanager
def paper() -> Iterator[None]:
    """Settings of a figure in a paper: 8 pt Times-like type, thin axes, TrueType fonts embedded in the PDF."""
    import matplotlib as mpl

    settings = {
        "font.family": "STIXGeneral",
        "mathtext.fontset": "stix",
        "font.size": 8,
        "axes.titlesize": 8,
        "axes.labelsize": 8,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "legend.fontsize": 7.5,
        "axes.linewidth": 0.5,
        "lines.linewidth": 1.1,
        "xtick.direction": "in",
        "ytick.direction": "in",
        "xtick.major.width": 0.5,
        "ytick.major.width": 0.5,
        "xtick.minor.width": 0.35,
        "ytick.minor.width": 0.35,
        "xtick.major.size": 3,
        "ytick.major.size": 3,
        "xtick.minor.size": 1.6,
        "ytick.minor.size": 1.6,
        "pdf.fonttype": 42,
    }
    with mpl.rc_context(settings):
        yield


def saved(figure: Figure, dpi: int = 300) -> dict[str, bytes]:
    """The figure as vector PDF with embedded fonts and as PNG, by file ending; the same figure gives the same bytes."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf

    FigureCanvasPdf(figure)
    files = {}
    for ending, metadata in (("pdf", {"CreationDate": None}), ("png", {})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=ending, dpi=dpi, metadata=metadata, bbox_inches="tight", pad_inches=0.02)
        files[ending] = buffer.getvalue()
    return files
