"""Scenes of docs/scenes at 32 pixels: corrected light, or what walks find precomputed, against walks by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import gallery_figure
from full_geometry.integrators import gathering
from full_geometry.scenes.scene_files import load_scene

pytestmark = [pytest.mark.usefixtures("rgb"), pytest.mark.filterwarnings("ignore")]

mi = pytest.importorskip("mitsuba")

FOLDER = Path(__file__).parent.parent.parent / "docs" / "scenes"
CORRECTED = ("leaf", "milk", "toy")
WALKED = ("ice", "jelly", "soap")


def _scene(name: str, model: str, light: str) -> mi.Scene:
    return load_scene(FOLDER / f"{name}.xml", model, parameters={"size": "32"}, settings={"light": light})


def _mean(scene: mi.Scene, spp: int, passes: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the image by channel with its standard error."""
    means = [np.array(mi.render(scene, spp=spp, seed=k), dtype=float)[..., :3].mean((0, 1)) for k in range(passes)]
    return np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / np.sqrt(passes)


def test_every_scene_loads_and_is_drawn() -> None:
    names = sorted(path.stem for path in FOLDER.glob("*.xml"))
    assert names == sorted(gallery_figure.SCENES)
    assert all(_scene(name, "path_traced", "auto").sensors() for name in names)
    draft, paper = gallery_figure.parts("draft"), gallery_figure.parts("paper")
    assert len({part.name for part in draft}) == len(draft) == len(paper) == 20


@pytest.mark.slow
@pytest.mark.parametrize("file", CORRECTED)
def test_corrected_light_has_the_mean_of_walks_within_its_error(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error is told of a point; means of objects are nearer."""
    monkeypatch.setattr(gathering, "DIRECTIONS", 2**16)
    scene = _scene(file, "better_dipole", "corrected")
    found, _ = _mean(scene, 32, 2)
    (told,) = (float(line.split("about ")[1].split("%")[0]) / 100 for line in scene.integrator().gathered)
    walked, error = _mean(_scene(file, "path_traced", "auto"), 48, 4)
    assert 0.01 < told < 0.25 and (error < 0.03 * walked).all()
    assert (np.abs(found - walked) < min(0.5 * told, 0.05) * walked + 4 * error).all(), (found / walked, told)


@pytest.mark.slow
def test_precomputed_light_of_two_media_has_the_mean_of_sampled_light() -> None:
    (found, one), (truth, other) = (
        _mean(_scene("fruit", "path_traced", light), 24, 6) for light in ("auto", "sampled")
    )
    error = np.hypot(one, other)
    assert (error < 0.03 * truth).all() and (found != truth).all()
    assert (np.abs(found - truth) < 0.005 * truth + 4 * error).all(), (found / truth, error / truth)


@pytest.mark.slow
@pytest.mark.parametrize("file", WALKED)
def test_nothing_that_does_not_absorb_is_seen_in_uniform_light(file: str) -> None:
    """Models refuse what lies inside or overlaps: walks see 1 everywhere where nothing is lost."""
    scene, seen = _scene(file, "path_traced", "auto"), mi.load_dict({"type": "translucent_walk"})
    known = mi.traverse(scene)
    for key in known.keys():
        if key.endswith("bsdf.albedo"):
            known[key] = 0 * known[key] + 1
        elif key.endswith(("reflectance.value", "radiance.value")):
            known[key] = 0 * known[key] + (key != "lamp.bsdf.reflectance.value")
    known.update()
    image = np.array(mi.render(scene, integrator=seen, spp=64), dtype=float).reshape(-1, 3)
    error = image.std(axis=0) / np.sqrt(len(image))
    assert (error < 0.005).all()
    assert (np.abs(image.mean(axis=0) - 1) < 4 * error).all()
