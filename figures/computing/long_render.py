"""A long image in passes that survive an interruption, as the result of a part."""

from __future__ import annotations

from typing import Any

import numpy as np

from figures.parts.part import Task
from halfspace_sss.provenance import check_folder

__all__ = ["long_render"]


def long_render(task: Task, scene: Any, spp_per_pass: int, passes: int) -> dict[str, Any]:
    """The image of a scene with its variance, seconds and samples; what is done of it is kept in the task's folder.

    Args:
        task: whose parameter "seed" is that of the first pass.
        scene: Mitsuba scene.
        spp_per_pass, passes: samples per pixel of each pass, and their number.
    """
    from halfspace_sss.rendering.scenes import reference

    found = reference.render(
        scene, check_folder(task.folder) / "passes.exr", spp_per_pass=spp_per_pass, seed=task.params["seed"],
        passes=passes, progress=lambda so_far: task.progress(so_far.passes, passes),
    )  # fmt: skip
    image, variance = (v[..., :3].astype(np.float32) for v in (found.mean, found.variance))
    return {"image": image, "variance": variance, "seconds": found.seconds, "spp": found.spp}
