"""Light that samplers of entries are compared under: a sky, a direction, a small light near the object.

Radiance is 1 from everywhere, irradiance 1 from a direction, or intensity 1. Weights of patches are fitted to it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from benchmarks.fits import Objective
from benchmarks.flow import Chart
from benchmarks.flow_training import FlowBatch, FlowRecipe, Lighting, likelihood_weights, walks_of
from full_geometry.geometry.points import EntrySample, cosine_above, opaque
from full_geometry.learning.network_fitting import PatchLogits, patch_likelihood
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import n_side
from full_geometry.transport.patches import PatchSampler
from full_geometry.transport.storing import Learnt
from halfspace_sss.arrays import Lanes
from halfspace_sss.neural.training.fit import fit
from halfspace_sss.tracing.walk import generator, pass_seed

LIGHTINGS = ("sky", "direction", "near light")
TOWARDS = np.array([0.48, 0.8, 0.36])  # the direction, and where the near light stands
GAP = 0.08  # of the near light from the surface, over the size of the object


def lighting(name: str, obj: TranslucentObject) -> Lighting:
    """A kind of light about an object: radiance 1 from everywhere, irradiance 1 from a direction, or intensity 1.

    Raises:
        ValueError: there is no such kind.
    """
    if name not in LIGHTINGS:
        raise ValueError(f"lighting must be one of {', '.join(LIGHTINGS)}, got {name!r}")
    towards = mi.Vector3f(*TOWARDS.tolist())
    place_of_light = mi.Point3f(*map(opaque, _above(obj)))

    def sky(entry: EntrySample, u: Lanes) -> tuple:
        w, density = cosine_above(entry.n_out, entry.n, u)
        return w, 1 / dr.maximum(density, 1e-6), mi.Float(dr.inf)

    def direction(entry: EntrySample, u: Lanes) -> tuple:
        return mi.Vector3f(towards), mi.Float(1), mi.Float(dr.inf)

    def near(entry: EntrySample, u: Lanes) -> tuple:
        d = place_of_light - entry.p
        r = dr.norm(d)
        return mi.Vector3f(d / r), 1 / (r * r), r

    return Lighting(obj, {"sky": sky, "direction": direction, "near light": near}[name])


def _above(obj: TranslucentObject) -> np.ndarray:
    """A point near the part of the surface that lies farthest towards the light."""
    p = np.array(obj.random_points(generator(mi, 4096, pass_seed(23))).p)
    return p[:, np.argmax(TOWARDS @ p)] + GAP * float(obj.geometry.size) * TOWARDS


def fit_patches(
    learnt: Learnt, recipe: FlowRecipe | None = None, *, light: Lighting | None = None, seed: int = 0
) -> PatchSampler:
    """Weights of the patches of a trained object by walks alone, or by walks times the light where they left.

    Args:
        learnt: the object.
        recipe: sizes and rates.
        light: that falls on the object; None fits to S itself.
        seed: of everything.
    """
    recipe, (model, sampler) = recipe or FlowRecipe(), learnt
    chart = Chart(model.object, sampler.frame, sampler.patches)
    net = PatchLogits(n_side(len(model.object.media)), sampler.patches.areas, recipe.patch_hidden, seed)

    def loss(batch: FlowBatch) -> torch.Tensor:
        walks, rows = batch
        x, patch = torch.from_numpy(walks.exit[rows].T.copy()), torch.from_numpy(walks.patch[rows])
        return patch_likelihood(net(x), likelihood_weights(batch), patch)

    fit(Objective(net, loss), walks_of(learnt, chart, recipe, light, seed), recipe.schedule, seed)
    return PatchSampler(sampler.frame, sampler.patches, net.arrays())
