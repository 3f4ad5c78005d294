"""Materials from images: the medium of an object whose images come closest to given ones.

views = inverse.read_views("views.json")
result = inverse.fit(scene, views, parameters=("albedo", "sigma_t"))      # scene: a file, a dict or a Mitsuba scene
"""

from full_geometry.inverse.comparing import FitSettings, MaterialFit
from full_geometry.inverse.fitting import fit
from full_geometry.inverse.views import GivenView, read_views

__all__ = ["MaterialFit", "FitSettings", "GivenView", "fit", "read_views"]
