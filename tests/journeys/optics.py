"""From nothing to the traced reflectance of a medium, curves in xarray, a material file, tissue and layers.

Each step is a page and lines of it, in the order in which an optics person meets them.
"""

STEPS = [
    # a medium and its reflectance
    ("docs/tracing.md", """
import halfspace_sss as sss
medium = sss.Medium.from_albedo(albedo=0.75, sigma_t=0.241, g=0.0, eta=1.3)  # lengths in mm
result = sss.trace(medium, mu_i=0.5, n_paths=1e6, seed=1, radii=[0.0, 1.0, 2.0], directions=[(1.0, 0.0)])
value, standard_error = result.reflectance("multiple")  # or "single", or "total"
print(value, standard_error, result.exitance().value, result.angular_reflectance().value, result.to_xarray())
"""),
    # curves of a measured medium and of models, in xarray
    ("docs/curves.md", "halfspace-sss models"),
    ("docs/curves.md", """
import halfspace_sss as sss
result = sss.curves("marble", channel="G", theta_i_deg=[0, 45], models=["better_dipole"], n_paths=50_000)
print(result.to_xarray(), result.errors()[["theta_i_deg", "series", "r_from_mm", "r_to_mm", "L1", "noise"]])
"""),
    # a medium of one's own, in a file and back
    ("docs/materials.md", "halfspace-sss materials show ketchup"),
    ("docs/materials.md", """
import halfspace_sss as sss
skin = sss.Medium.from_reflectance([0.72, 0.48, 0.38], mfp=[1.2, 0.4, 0.2], g=0.8, eta=1.4)
sss.materials.write("mine.toml", sss.materials.Material("my skin", skin, channels=("R", "G", "B")))
print(sss.materials.register("mine.toml"), sss.materials.load("my skin").medium)  # the same with all digits
"""),
    # spectra, in a file and back
    ("docs/materials.md", """
import numpy as np
import halfspace_sss as sss
nm = np.arange(380.0, 781.0, 10.0)
jelly = sss.materials.SpectralMedium(nm, sigma_s=2.0, sigma_a=0.5 * (nm / 380) ** -6, g=0.3, n=1.36)
jelly.to_csv("jelly.csv")
print(sss.materials.read_spectra("jelly.csv").medium(550))  # the same with all digits
"""),
    # tissue at a wavelength
    ("docs/biomedical.md", """
import halfspace_sss as sss
dermis = sss.materials.tissue(4.36, 0.41, 0.562, blood=0.01, oxygenation=0.7, water=0.65)  # a' in 1/mm, f, b
print(dermis.medium([450, 550, 650]), dermis.to_rgb())
run = sss.trace(sss.materials.skin("III").layers(550), n_paths=50_000)  # epidermis on dermis, at 550 nm
print(run.reflectance())
"""),
    # layers
    ("docs/biomedical.md", """
import halfspace_sss as sss
epidermis = sss.Medium(sigma_s=40.0, sigma_a=1.0, g=0.8, eta=1.45)
dermis = sss.Medium(sigma_s=20.0, sigma_a=0.1, g=0.8, eta=1.38)
skin = sss.Layers([epidermis, dermis], thickness=[0.06])  # mm; the last layer is semi-infinite
run = sss.trace(skin, n_paths=100_000, radii=[0.0, 0.5, 1.0])
print(run.reflectance(), run.reflectance_by_layer().value, run.exitance_by_layer().value, run.absorptance().value)
"""),
]  # fmt: skip
