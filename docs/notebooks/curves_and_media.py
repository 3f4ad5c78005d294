# %% [markdown]
# # Curves and media
#
# A notebook for Jupytext, and a script. Needs `pip install "halfspace-sss[figures]"`.

# %%
import halfspace_sss as sss

# %% [markdown]
# Media are measured, stated by coefficients, or inverted from a colour and a mean free path in mm.

# %%
marble = sss.materials.load("marble")
soap = sss.Medium.from_albedo(albedo=0.95, sigma_t=2.0, g=0.5, eta=1.4)
skin = sss.Medium.from_reflectance([0.72, 0.48, 0.38], mfp=[1.2, 0.4, 0.2], g=0.8, eta=1.4)
for medium in (marble.medium, soap, skin):
    print(medium, medium.reflectance())

# %%
marble

# %% [markdown]
# The reflectance of the half-space by a random walk, with its standard error, beside the exact one.

# %%
walk = sss.trace(soap, mu_i=0.5, n_paths=50_000, seed=1)
print(*walk.reflectance(), soap.reflectance(mu_i=0.5))

# %% [markdown]
# S along a line of exit points, path traced and by models. A notebook shows the plot above the errors: `L1` is that of
# a model over a range of distances, `noise` that of the walks. `curves.plot()` is a figure of matplotlib.

# %%
curves = sss.curves(soap, theta_i_deg=[0, 60], models=["better_dipole", "neural"], n_paths=50_000)
curves
