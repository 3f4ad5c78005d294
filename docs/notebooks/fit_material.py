# %% [markdown]
# # A material from images
#
# Four images of a ball under a lamp, then its albedo and mean free path from them alone.
# A notebook for Jupytext, and a script. Needs `pip install "halfspace-sss[render]"`.

# %%
import halfspace_sss  # noqa: F401  before Mitsuba, so that Dr.Jit finds its LLVM

# isort: split
import mitsuba as mi
import numpy as np

import full_geometry
from full_geometry import inverse

mi.set_variant("llvm_ad_rgb")
full_geometry.register()

# %% [markdown]
# The scene: cameras and lights are known. Lengths are mm, `sigma_t` is one over the mean free path.


# %%
def scene(albedo: str, sigma_t: str, pixels: int = 12) -> mi.Scene:
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}}
    lamp = {"type": "sphere", "center": [0, 0, 80], "radius": 20, "emitter": {"type": "area", "radiance": 15.0}}
    medium = {"type": "translucent", "albedo": albedo, "sigma_t": sigma_t, "eta": 1.3}
    parts = {
        "type": "scene",
        "integrator": {"type": "translucent_walk", "hide_emitters": True},
        "lamp": lamp,
        "ball": {"type": "sphere", "radius": 5.0, "bsdf": medium},
    }
    for k, angle in enumerate(np.radians([10, 50, 90, 130])):  # between lamp and camera
        at = mi.ScalarTransform4f().look_at([40 * np.sin(angle), 0, 40 * np.cos(angle)], [0, 0, 0], [0, 1, 0])
        parts[f"camera_{k}"] = {"type": "perspective", "fov": 15.0, "to_world": at, "film": film}
    return mi.load_dict(parts)


# %% [markdown]
# Images of the truth, here by walks in place of a camera. A view says which image belongs to which camera.

# %%
truth = scene("0.95, 0.9, 0.7", "1, 0.5, 0.67")
images = [np.array(mi.render(truth, sensor=k, spp=512, seed=k)) for k in range(4)]
views = [inverse.GivenView.of(f"image {k}", k, image) for k, image in enumerate(images)]

# %% [markdown]
# From a wrong start, a few Gauss-Newton steps. More steps and samples make the errors smaller.

# %%
settings = inverse.FitSettings(steps=10, spp=32)
found = inverse.fit(scene("0.8", "1"), views, ("albedo", "mfp"), settings=settings)
for name, value in found.values.items():
    print(name, value.round(3), "±", found.errors[name].round(3))
print(f"misfit of the images: {found.misfit.value:.3f} ± {found.misfit.standard_error:.3f}")

# %% [markdown]
# Above the given images, below those of what was found.

# %%
rows = [np.concatenate([getattr(view, which) for view in found.views], axis=1) for which in ("given", "found")]
mi.util.convert_to_bitmap(mi.TensorXf(np.concatenate(rows).repeat(10, axis=0).repeat(10, axis=1)))

# %% [markdown]
# The scene with what was found, rendered like any other; or `found.medium` for curves and models.

# %%
print(found.medium)
