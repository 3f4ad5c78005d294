"""The command `halfspace-sss view`: a scene in the browser, with its light, media and models under sliders."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated

import typer

from full_geometry.cli.variants import SceneOptions, use_mitsuba
from halfspace_sss.cli import shared
from halfspace_sss.interrupts import interrupts

PORT = 8080


def view(
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML or glTF file whose objects use the BSDF `translucent`.")],
    options: SceneOptions,
    host: Annotated[str, typer.Option(help="Address; another than a loopback one asks for a token.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port.")] = PORT,
    side: Annotated[int, typer.Option(help="Root of the number of pixels.")] = 256,
) -> None:
    """Look at a scene in the browser: turn it, move its light, change media and models, until Ctrl-C.

    The address is printed. Scenes are saved beside the file, and no file of another folder is read.
    """
    use_mitsuba(options.variant)
    from full_geometry.viewing.page import Page

    page = Page(scene, host, port, side**2, options.parameters())
    try:
        shared.say(f"{page.url}  (Ctrl-C ends)")
        while not threading.Event().wait(0.2):
            interrupts.check()
            page.check()
    finally:
        page.close()
