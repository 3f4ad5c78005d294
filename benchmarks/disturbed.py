"""The command `disturbed`: views held out of a fit to photographs of a wrong exposure, fewer or noisy ones."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import typer

from benchmarks.kept_rows import KeptRows
from benchmarks.tables import markdown
from full_geometry.cli.fit import DescentOptions, FittedOptions
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_choice
from halfspace_sss.cli.shared import Bar, OutFolder, console
from halfspace_sss.provenance import check_folder, write_together

if TYPE_CHECKING:
    from full_geometry.inverse.views import GivenView


class Disturbance(NamedTuple):
    """What is wrong with photographs: a factor of all, every how manieth is fitted, noise over the mean of each."""

    exposure: float = 1.0
    every: int = 1
    noise: float = 0.0

    def of(self, views: Sequence[GivenView], seed: int) -> list[GivenView]:
        """Disturbed views; those that are held out have the exposure too, but no noise, and all stay."""
        result, random, fitted = [], np.random.default_rng(seed), 0
        for view in views:
            image = self.exposure * view.image
            if not view.held_out:
                fitted += 1
                if (fitted - 1) % self.every:
                    continue
                level = self.noise * float(image[view.counts > 0].mean())
                image = image + level * random.standard_normal(image.shape)
            result.append(replace(view, image=image.astype(np.float32)))
        return result


CASES = {
    "as given": Disturbance(),
    "exposure": Disturbance(exposure=1.1),
    "half": Disturbance(every=2),
    "noise": Disturbance(noise=0.02),
    "all": Disturbance(exposure=1.1, every=2, noise=0.02),
}


def disturbed_command(
    scene: Annotated[Path, typer.Argument(help="As of `halfspace-sss fit`.")],
    images: Annotated[Path, typer.Option(help="JSON file of the views; some are held out.")],
    fitted: FittedOptions,
    descent: DescentOptions,
    case: Annotated[
        list[str] | None, typer.Option(help=f"{', '.join(CASES)}; repeat for more.", show_default="all of them")
    ] = None,
    out: OutFolder = Path("disturbed"),
) -> None:
    """Fit photographs as they are, 1.1 times as bright, every other one, with noise of 2 % of their mean, and all that.

    The table tells the median relative L1 of views held out. Cases that are finished are kept in --out.
    """
    chosen = case or list(CASES)
    for name in chosen:
        check_choice("case", name, CASES)
    check_folder(out)
    use_mitsuba("llvm_ad_rgb")
    import pandas

    from full_geometry import inverse

    settings, names = inverse.FitSettings(**vars(descent)), [name.strip() for name in fitted.parameter.split(",")]
    views = inverse.read_views(images)
    kept = KeptRows(out / "disturbed.part", {**vars(fitted), **vars(descent), "scene": str(scene.resolve())})
    for name in chosen:
        if name in kept:
            continue
        began = time.process_time()
        with Bar(f"fit, {name}") as bar:
            found = inverse.fit(
                scene, CASES[name].of(views, settings.seed), names, fitted.model, object=fitted.object,
                settings=settings, progress=bar.show,
            )  # fmt: skip
        held = [view.relative_l1 for view in found.views if view.held_out]
        kept[name] = {
            "case": name, "views": len(found.views) - len(held), "held out": len(held),
            "median relative L1, %": 100 * float(np.median(held)), "CPU s": time.process_time() - began,
        }  # fmt: skip
    frame = pandas.DataFrame(list(kept.values()))
    write_together({out / "disturbed.csv": frame.to_csv(index=False, lineterminator="\n")})
    console().print(markdown(frame), highlight=False, markup=False, soft_wrap=True)
