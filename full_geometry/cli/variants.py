"""What commands on scenes share: Mitsuba under a variant, its warnings as ours, and what draws results."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from halfspace_sss.backend import BackendError, needed, prepare_llvm
from halfspace_sss.cli import shared
from halfspace_sss.interrupts import interrupts

if TYPE_CHECKING:
    from full_geometry.inverse.comparing import MaterialFit
    from full_geometry.scenes.reference_store import Picture
    from full_geometry.trade.images import TradePicture

Variant = Annotated[
    Literal["llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono"], typer.Option(help="Variant of Mitsuba.")
]


@dataclass(frozen=True)
class SceneOptions:
    """How a scene is loaded."""

    define: shared.Define = None
    variant: Variant = "llvm_ad_rgb"

    def parameters(self) -> dict[str, str]:
        """Values of $NAME."""
        return shared.defined(self.define)


@dataclass(frozen=True)
class Drawers:
    """Functions that draw results as {file ending: content}: the object of the context, from above; None: undrawn."""

    render: Callable[[Picture], dict[str, bytes]]
    fit: Callable[[MaterialFit], dict[str, bytes]]
    trade: Callable[[TradePicture], dict[str, bytes]]


def use_mitsuba(variant: str) -> None:
    """Mitsuba with our plugins, under a variant."""
    if variant.startswith("llvm"):
        prepare_llvm()
    mi = needed("mitsuba", "rendering needs Mitsuba 3", "render")
    import full_geometry

    try:
        mi.set_variant(variant)
    except ImportError as error:
        raise BackendError(f"variant {variant} does not run here: {error}") from error
    full_geometry.register()
    _hear_warnings()


def _hear_warnings() -> None:
    """Mitsuba's warnings as ours, on stderr: by itself it prints them among the results."""
    import mitsuba as mi

    class Lines(mi.Appender):
        def __init__(self) -> None:
            mi.Appender.__init__(self)

        def append(self, level: mi.LogLevel, text: str) -> None:
            if "Received interrupt signal" in text:  # while it renders Mitsuba listens in the place of Python
                interrupts.received = interrupts.received or signal.SIGINT
            elif level >= mi.LogLevel.Warn:
                typer.echo(f"warning: {' '.join(text.split())}", err=True)

        def log_progress(self, *_: object) -> None:
            pass

    logger = mi.logger()
    for part in ("date", "class", "thread", "log_level"):
        getattr(logger.formatter(), f"set_has_{part}")(False)
    logger.clear_appenders()
    logger.add_appender(Lines())
