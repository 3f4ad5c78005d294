# %% [markdown]
# # An object rendered three ways
#
# A ball of ketchup lit from behind: as a diffuse surface, by the network of a half-space, and by random walks inside.
# A notebook for Jupytext, and a script. Needs `pip install "halfspace-sss[render]"`.

# %%
import halfspace_sss  # noqa: F401  before Mitsuba, so that Dr.Jit finds its LLVM

# isort: split
import mitsuba as mi
import numpy as np

import full_geometry

mi.set_variant("llvm_ad_rgb")
full_geometry.register()  # `translucent`, `bssrdf` and `translucent_walk`

# %% [markdown]
# One scene; the integrator and the model of the surface change. Lengths of the medium are mm; the ball is 10 mm across.


# %%
def image(integrator: str, model: str, size: int = 64, spp: int = 16) -> np.ndarray:
    camera = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    lamp = mi.ScalarTransform4f().look_at([1.5, 2, -2.5], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "mm_per_unit": 5.0, "hide_emitters": True},
            "sky": {"type": "constant", "radiance": 0.1},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 6.0}},
            "ball": {"type": "sphere", "bsdf": {"type": "translucent", "material": "ketchup", "model": model}},
            "sensor": {
                "type": "perspective",
                "to_world": camera,
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
            },
        }
    )
    return np.array(mi.render(scene, spp=spp, seed=1))


# %%
ways = {
    "diffuse": image("bssrdf", "lambert"),
    "half-space": image("bssrdf", "neural"),
    "walks": image("translucent_walk", "neural"),
}
for name, pixels in ways.items():
    print(f"{name}: mean radiance {pixels.mean(axis=(0, 1)).round(4)}")

# %% [markdown]
# What the light crosses shows the difference: a diffuse surface sends none of it through the ball.
# From left to right: diffuse, half-space, walks. `mi.util.write_bitmap` writes a file.

# %%
row = np.concatenate(list(ways.values()), axis=1)
mi.util.convert_to_bitmap(mi.TensorXf(row.repeat(3, axis=0).repeat(3, axis=1)))
