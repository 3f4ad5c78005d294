"""Measured materials by name: what was published, in 1/mm, with the source of every number.

`names()` lists them, `load(name)` gives a `Material`, `table()` all of them as numbers, `register()` adds one, and
`write()` makes a file of some.
Besides the materials that come with the library, the registry reads on first use every `*.toml` in

- the folders (or files) listed in the environment variable HALFSPACE_SSS_MATERIALS, separated as in PATH,
- the user's configuration folder, `~/.config/halfspace-sss/materials` (`%APPDATA%` on Windows),
- what packages offer as entry point of the group `halfspace_sss.materials`: an entry point is the path of a TOML file
  or folder, or an iterable of `Material`.

A material file has one or more `[[material]]` tables:

    set = "mine"                    # any name for the group
    unit = "1/mm"                   # or "1/cm"
    eta = 1.4                       # here, or in each [[material]]
    source = "own measurement, 3 July 2024"
    channels = ["R", "G", "B"]      # left out: one channel
    assumptions = ["eta: not measured"]

    [[material]]
    name = "soap"
    sigma_s_prime = [1.3, 1.4, 1.6] # or sigma_s with g; or sigma_t, albedo and g, without sigma_a
    sigma_a = [0.01, 0.02, 0.04]

Optional keys: g (with sigma_s_prime; without it g is taken as 0 and may be chosen on loading), dilutable, sample_ml and
tank_ml (the published dilution), note, and a table [sources] that tells for each quantity where its numbers come from.
"""

from halfspace_sss.materials.catalogue import load, names, register, table, write
from halfspace_sss.materials.material import Material
from halfspace_sss.materials.spectra import RGBMedium, SpectralMedium, read_spectra
from halfspace_sss.materials.spheres import SphereSample, from_spheres
from halfspace_sss.materials.tissues import Skin, Tissue, published_tissue, skin, tissue

__all__ = [
    "Material", "RGBMedium", "Skin", "SpectralMedium", "SphereSample", "Tissue", "from_spheres", "load", "names",
    "published_tissue", "read_spectra", "register", "skin", "table", "tissue", "write",
]  # fmt: skip
