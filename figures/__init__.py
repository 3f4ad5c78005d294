"""The figures of the paper: what each is made of, apart from how it is drawn, so that only what changed is computed.

A figure is one file, `figures/NAME.py`, and one entry below; other packages add figures by entry points of the group
`halfspace_sss.figure_modules`, name = module. The module has

- `TITLE`: a few words for `halfspace-sss figures list`;
- `parts(quality) -> list[Part]`: what is to be computed, for the quality "draft" (minutes on two cores) or "paper";
- `draw(results) -> {file name: bytes or str}`: pictures, pages and tables from the results, by name of the part.

`figures.parts.runner.compute(name, quality, folder)` computes the parts, `figures.parts.runner.draw(...)` writes what
is drawn.

A `Part` is a name, parameters ready for JSON, a function and its estimated work:

    def render(task: Task) -> dict[str, object]:
        image = ...task.params["material"]...        # task.progress(done, total) moves the bar
        return {"image": image, "variance": variance, "mean": float(image.mean())}

    Part("marble, neural", render, {"material": "marble", "model": "neural", "spp": 64}, work=64 * 256**2)

- Arrays of shape (height, width) or (height, width, 3) are kept as float32 EXR; everything else must be ready for
  JSON. Both are checked: a NaN is refused with the name of the part.
- A part is computed again when its parameters, the content of a file in `inputs` (weights, scenes), a part in `needs`
  or any code changed: that of the packages but for commands and drawing, and of the module of its function but for
  `draw`. A part that is damaged is computed again and named in a warning. One that another figure has in the same
  quality, as trainings of the same object are, is taken from there.
- `needs` names parts that stand before it in the list; their results are in `task.needed`. `task.folder` is kept
  until the part is done: passes of a long render stored there survive an interruption.
- For images: `figures.computing.images.compared` makes shots with FLIP, relMSE and maps from results;
  `figures.drawing.image_grid` and `figures.drawing.page` draw the same {scene: [shots]} as PDF and
  PNG, and as a page that flips between them.
- Seconds for a unit of `work` are measured: what a draft took says what the paper quality will take.
"""

from __future__ import annotations

__all__ = ["FIGURES", "figure_modules"]

FIGURES = ("fig05", "fig06", "fig09", "fig10", "fig12")
GROUP = "halfspace_sss.figure_modules"
ADDED: dict[str, str] = {}  # name -> module of figures that a program adds, as `benchmarks` does


def figure_modules() -> dict[str, str]:
    """The module of each figure by its name, those of other packages last; a name that is taken is not given anew."""
    from importlib.metadata import entry_points  # 60 ms in which the command would not hear Ctrl-C yet

    added = {entry.name: entry.value for entry in entry_points(group=GROUP)} | ADDED
    own = {name: f"figures.{name}" for name in FIGURES}
    return own | {name: module for name, module in added.items() if name not in own}
