"""Renders of scenes whose objects are trained first: walks until they are, and both in one image.

    online.render("scene.xml", "image.exr", train_seconds=60, spp=256)

Walks from the camera, exact and with light of all orders, make an image, and where they leave the object is what its
model is learnt from, beside walks from random points. Once the error of the model is small enough, or the time for
learning is over, the model renders, and the image is the mean of the two by their variances (`combined`).
"""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.learning.learners import LearntObject, learner, learners
from full_geometry.objects.objects import outermost, translucent_shapes
from full_geometry.scenes import reference
from full_geometry.scenes.camera_walks import CameraWalks
from full_geometry.scenes.reference import Denoise
from full_geometry.scenes.reference_store import BY_CHANCE, Reference, load, save
from full_geometry.surface.wrapped import surface_of, wrapping_of
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.store import weights_folder
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder

TRAINING = "training"
TRAIN_ERROR = 0.03


class Listeners(NamedTuple):
    """What is called on the way, if anything.

    Args:
        rendered, walked: after each pass of the model, and of walks, with the image.
        learnt: with (what, done, total) while an object is learnt.
        told: with a sentence before an object is learnt.
    """

    rendered: reference.Progress | None = None
    walked: reference.Progress | None = None
    learnt: NamedProgress | None = None
    told: Callable[[str], None] = lambda sentence: None


def files(path: Path) -> dict[str, Path]:
    """Beside the image at `path`: the images by walks and by the model that it is made of, and unfinished training."""
    return {name: path.with_suffix(f".{name}") for name in ("walks.exr", "model.exr", "training")}


def untrained(scene: mi.Scene) -> dict[str, list[str]]:
    """Ids of the objects that have to be trained before the scene can be rendered, by the name of their model.

    Raises:
        ValueError: one cannot be learnt, or there is no place for its weights.
    """
    if not is_bssrdf(scene.integrator()):
        return {}
    specs = [surface_of(shape).spec for shape in translucent_shapes(scene)]
    names, known, results = sorted({spec.model for spec in specs}), learners(), {}
    for name in names:
        if name in known and (ids := known[name].untrained(scene)):
            results[name] = ids
    return results


def render(
    scene: mi.Scene | dict[str, Any] | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    train_seconds: float,
    train_error: float = TRAIN_ERROR,
    sensor: int = 0,
    seed: int = 0,
    resume: bool | str | os.PathLike[str] = True,
    listeners: Listeners = Listeners(),  # noqa: B008
    denoise: Denoise | None = None,
    **limits: Any,
) -> Reference:
    """`reference.render`, before which objects without weights are learnt from walks that join the image.

    The limits are those of the model's image; what walks have traced comes on top. Walks join the image if every
    translucent object of the scene has a model that is learnt: others are to look as their models have it. A run that
    was killed and goes on ends with the same weights and the same image.

    Args:
        scene: a dict, the path of an XML file, or a Mitsuba scene.
        path: of the EXR file; while it is made, the parts are beside it, see `files`.
        train_seconds: time for each object whose model has to be trained; 0 refuses objects without weights.
        train_error: relative error under constant light, measured on the way, from which on it has learnt enough.
        sensor: number of the sensor.
        seed: of walks, learning and render.
        resume: True goes on with what is at `path`, False begins anew, another path goes on with what is there.
        listeners: what is called on the way.
        denoise: as of `reference.render`; of an image with walks in it no halves are kept.
        limits: fields of `reference.Limits`.

    Returns:
        The image; `about["combined"]` tells of the two phases, `about["training"]` of what was learnt.

    Raises:
        ValueError: as `reference.render`, or an object cannot be learnt; nothing has been traced then.
    """
    path = Path(path)
    check_count("seed", seed, 0)
    check_interval("train_seconds", train_seconds, 0.0, 1e7)
    check_interval("train_error", train_error, 1e-4, 1.0)
    reference.Limits(**limits)
    check_folder(path.parent)
    scene, integrator = reference.loaded(scene, None, sensor)
    about = reference.about_render(scene, integrator, sensor, seed)
    parts, base = files(path), path if isinstance(resume, bool) else Path(resume)
    if resume is False:
        _forget(parts)
    elif base != path:  # goes on with the parts of a finished image, which stay as they are
        for name, there in files(base).items():
            if name != TRAINING and there.exists() and not parts[name].exists():
                save(parts[name], load(there))
    names = untrained(scene) if train_seconds > 0 else {}
    how = {"sensor": sensor, "seed": seed, "progress": listeners.rendered, "denoise": denoise, **limits}
    if not names and not parts["walks.exr"].exists():
        if is_bssrdf(integrator):
            integrator.prepare(scene)  # here, because Mitsuba wraps what is refused while it renders
        return reference.render(scene, path, resume=resume, **how)
    walks = CameraWalks(scene, integrator.settings, sensor, seed, parts["walks.exr"], about, listeners.walked)
    if walks.found is not None:
        reference.check_same(walks.found, parts["walks.exr"], about)
    if names:
        walks.check()
        integrator.check(scene, [name for ids in names.values() for name in ids])
    enough = {"seconds": train_seconds, "target_error": train_error, "seed": seed}
    records = _learnt(scene, walks, enough, parts["training"], listeners)
    integrator.prepare(scene)
    if walks.found is None:
        result = reference.render(scene, path, resume=resume, **how)
        result = replace(result, about={**result.about, TRAINING: records})
    else:
        model = reference.render(scene, parts["model.exr"], **how)
        result = combined(walks.found, model).without_halves()
        result = replace(result, about={**result.about, TRAINING: walks.found.about.get(TRAINING, [])})
    save(path, result)
    shutil.rmtree(parts["training"], ignore_errors=True)
    return result


def _learnt(
    scene: mi.Scene, walks: CameraWalks, enough: dict[str, Any], work: Path, listeners: Listeners
) -> list[dict[str, Any]]:
    """Learn one object after the other; those of the same mesh and medium share what was learnt."""
    camera, records = walks if _join(scene) else None, []
    while enough["seconds"] > 0 and (names := untrained(scene)):
        model, (name, *_) = next(iter(names.items()))
        if any(name == record["object"] for record in records):
            raise ValueError(f"weights of object {name!r} must be found once they are written, got none")
        listeners.told(_sentence(name, model, enough, camera is not None))
        result = learner(model).train(
            scene, object=name, **enough, folder=None, work=work / f"{zlib.crc32(name.encode()):08x}",
            progress=listeners.learnt, camera=camera,
        )  # fmt: skip
        records.append(_record(result, model))
        if walks.found is not None:
            known = walks.found.about.get(TRAINING, [])
            walks.found = replace(walks.found, about={**walks.found.about, TRAINING: [*known, records[-1]]})
            walks.save()
    return records


def _join(scene: mi.Scene) -> bool:
    """Whether walks show what the models show: all objects are learnt and unmasked, and paths go past an object.
    Exits on instances are of several places, and no data for learning."""
    shapes, own = outermost(scene), scene.shapes()
    alone = all(any(shape is each for each in own) for shape in shapes)
    around = map(wrapping_of, shapes)
    learnt = alone and all(each.surface.spec.model in learners() and not each.mixes for each in around)
    return scene.integrator().settings.max_depth != 1 and learnt


def _sentence(name: str, model: str, enough: dict[str, Any], joined: bool) -> str:
    use = "which join the image" if joined else "which cannot join the image"
    return (
        f"object {name!r} has no weights of {model} yet: it is learnt for {enough['seconds']:g} s, or until its "
        f"error is below {100 * enough['target_error']:g} %, from walks, {use}; then the model renders; weights are "
        f"kept in {weights_folder()}"
    )


def _record(learnt: LearntObject, model: str) -> dict[str, Any]:
    """What the header of the image tells of a training."""
    about = {"object": learnt.object, "model": model, "weights": learnt.path.name if learnt.path else None}
    errors = [row._asdict() for row in learnt.errors]
    return about | {"steps": learnt.steps, "seconds": learnt.seconds, "errors": errors}


def _forget(parts: dict[str, Path]) -> None:
    """Remove what a run before left."""
    for path in parts.values():
        if path.suffix == ".training":
            shutil.rmtree(path, ignore_errors=True)
        else:
            for one in (path, path.with_suffix(".json")):
                one.unlink(missing_ok=True)


# --------------------------------------------------------------------------------------------------
# One image from two of the same scene, by walks and by a model: inverse-variance weights, cross-weighted.


TILE = 8  # pixels


def combined(walks: Reference, model: Reference) -> Reference:
    """s walks + (1 - s) model, with the share s = V_model / (V_walks + V_model) that has the smallest variance.

    The image is cut into tiles like a chessboard. In each the variances of the mean are summed over pixels and colours,
    and V is the square of the mean of the roots of these sums, so that a single spike, as walks have them that find a
    small light by chance, does not decide alone. As a pixel that happens to be bright has a large variance too, weights
    from the pixels themselves would darken the image. Tiles are cross-weighted: white ones take s from the black ones
    and the other way round, as the two buffers of Rousselle, Knaus and Zwicker (2012) filter each other. Filters
    wider than a box let neighbours at the edges of tiles share samples. With fewer than two passes of one of them, or
    where neither varies, s is the share of the samples. The bias of the model does not count.

    Args:
        walks, model: of the same scene and sensor. What `model` is about is kept; `about["combined"]` tells the rest.
    """
    share = np.zeros(model.mean.shape[:2])
    row, column, tiles = _tiles(*share.shape)
    white = (row + column) % 2 == 0
    for to, of in ((white, ~white), (~white, white)):
        share[to] = _share(walks, model, np.where(of, tiles, -1))
    s = share[..., None]
    about = {"share_of_walks": float(share.mean()), "walks": _told(walks), "model": _told(model)}
    mean = s * walks.mean + (1 - s) * model.mean
    variance = s**2 * walks.variance + (1 - s) ** 2 * model.variance
    return replace(
        model, mean=mean, variance=variance,
        passes=walks.passes + model.passes, spp=walks.spp + model.spp, seconds=walks.seconds + model.seconds,
        about={**{k: v for k, v in model.about.items() if k != BY_CHANCE}, "combined": about},
    )  # fmt: skip


def _tiles(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and number of the tile of each pixel."""
    side = max(min(TILE, height // 2, width // 2), 1)
    row, column = np.indices((height, width)) // side
    return row, column, row * (column.max() + 1) + column


def _share(walks: Reference, model: Reference, tiles: np.ndarray) -> float:
    """s from the pixels whose tile is not -1."""
    by_walks, by_model = (_spread(image.variance[..., :3], tiles) ** 2 for image in (walks, model))
    if min(walks.passes, model.passes) < 2 or not by_walks + by_model > 0:
        return walks.spp / (walks.spp + model.spp)
    return by_model / (by_walks + by_model)


def _spread(variance: np.ndarray, tiles: np.ndarray) -> float:
    """Mean over tiles of the root of the sum of variances."""
    inside = tiles >= 0
    sums = np.bincount(tiles[inside], weights=variance[inside].sum(axis=-1))
    counts = np.bincount(tiles[inside])
    return float(np.sqrt(np.maximum(sums[counts > 0], 0)).mean()) if inside.any() else 0.0


def _told(image: Reference) -> dict[str, float | int | None]:
    error = image.relative_error if np.isfinite(image.relative_error) else None
    return {"spp": image.spp, "passes": image.passes, "seconds": image.seconds, "relative_error": error}
