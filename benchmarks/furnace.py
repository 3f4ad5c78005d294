"""The white furnace: a large ball without absorption in light of radiance 1, which has radiance 1 by exact transport.

A half-space model shows in it how much light it makes or loses over all distances and directions; edges and curvature
add nothing, as the middle of a ball of 1000 mean free paths fills the picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.tables import markdown
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_count
from halfspace_sss.cli.shared import Bar, OutFolder, console, whole
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import check_folder, write_together

ALBEDO, ETA = 1.0, 1.5  # exactly: by 1 - 1e-6 a half-space absorbs 0.5 %
RADIUS = 1000.0  # mean free paths: what a half-space lets out farther away than the ball is wide is below 1 %
SEEN = 0.7  # of the radius: the corners of the image see the ball too
WALK_SPP = 4  # every walk comes back with weight 1


def mean_radiance(model: str, size: int, spp: int, seed: int = 3) -> tuple[float, float]:
    """Mean radiance of the ball and its standard error, by a model or "path_traced", size x size pixels."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    at = mi.ScalarTransform4f()
    view = at.look_at([0, 0, 2 * RADIUS], [0, 0, 0], [0, 1, 0]) @ at.scale([SEEN * RADIUS, SEEN * RADIUS, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    surface = {"type": "translucent", "sigma_s": ALBEDO, "sigma_a": 1 - ALBEDO, "g": 0.0, "eta": ETA}
    scene = {
        "type": "scene",
        "integrator": {"type": "bssrdf"},
        "sensor": {"type": "orthographic", "to_world": view, "film": film},
        "sky": {"type": "constant", "radiance": 1.0},
        "ball": {"type": "sphere", "radius": RADIUS, "bsdf": surface},
    }
    spp = min(spp, WALK_SPP) if model == PATH_TRACED else spp
    image = np.array(mi.render(load_scene(scene, model), spp=spp, seed=seed), dtype=np.float64)
    pixels = image[..., :3].mean(axis=2).ravel()
    return float(pixels.mean()), float(pixels.std(ddof=1) / np.sqrt(pixels.size))


def furnace_command(
    size: Annotated[int, typer.Option(help="Pixels of the square images.", parser=whole)] = 32,
    spp: Annotated[int, typer.Option(help="Samples a pixel, of walks at most 4.", parser=whole)] = 4096,
    out: OutFolder = Path("furnace"),
) -> None:
    """Measure the radiance of a ball without absorption in light of radiance 1, by walks and half-space models."""
    use_mitsuba("llvm_ad_rgb")
    import pandas

    from figures.computing.learnt import accepting
    from full_geometry.scenes.scene_files import PATH_TRACED

    check_count("size", size, 2)
    check_count("spp", spp, 1)
    check_folder(out)
    models, rows = (PATH_TRACED, *accepting(Medium.from_albedo(ALBEDO, 1.0, 0.0, ETA))), []
    with Bar("furnace") as bar:
        for k, model in enumerate(models):
            bar.show(k, len(models), model)
            mean, error = mean_radiance(model, size, spp)
            rows.append({"model": model, "mean radiance": mean, "standard error": error})
    table = pandas.DataFrame(rows)
    text = markdown(table.round(5))
    write_together({out / "furnace.csv": table.to_csv(index=False, lineterminator="\n"), out / "furnace.md": text})
    console().print(text, highlight=False, markup=False, soft_wrap=True)
