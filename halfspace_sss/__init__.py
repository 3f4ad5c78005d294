"""Half-space subsurface scattering: path-traced, analytic and learnt BSSRDFs behind one definition.

Conventions, kept by every part of the library:

- Plane z = 0, outward normal +z, medium below. x_i is where light enters, x_o where it leaves.
- w_i and w_o are unit vectors that both point away from the surface, outside; mu = cos(theta) = w.z.
- L_o(x_o, w_o) = ∫_A ∫_2pi S(x_i, w_i; x_o, w_o) L_i(x_i, w_i) mu_i dw_i dA_i, hence S = dL_o / dPhi_i in 1/(mm² sr).
  S contains both Fresnel transmittances; it contains no surface reflection and no cosine.
- Reciprocity: S(x_i, w_i; x_o, w_o) = S(x_o, w_o; x_i, w_i). A model that violates it says so.
- A query has five numbers: r = |x_o - x_i|, mu_i, phi_i, mu_o, phi_o; both azimuths are measured about +z from the
  direction x_i -> x_o. S is unchanged under (phi_i, phi_o) -> (-phi_i, -phi_o).
- Scaling: S(r; sigma_t) = sigma_t² S(sigma_t r; 1). Tracer, maps and networks work in mean free paths.
- Orders: `single` is exactly one scattering event, `multiple` two or more, `total` their sum. For a pencil beam the
  single order is a distribution, not a function; it is evaluated as its own line integral.
- Reflectance: R(mu_i) = ∫∫ S mu_o dw_o dA_o, the fraction of incident flux that comes back out of the medium.
- eta = n_inside / n_outside. albedo = sigma_s / sigma_t is the single-scattering albedo, never a colour.
- Lengths are mm. Angles are radians.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.backend import prefer_bundled_llvm
from halfspace_sss.lazy import lazy_names

__version__ = "0.1.0"

if TYPE_CHECKING:
    from halfspace_sss import materials, measure, neural
    from halfspace_sss.comparison.reflectance_curves import curves
    from halfspace_sss.interface.model import BSSRDF
    from halfspace_sss.maps.map_store import make_maps
    from halfspace_sss.physics.medium import Layers, Medium
    from halfspace_sss.registry import bssrdf, models, register_model
    from halfspace_sss.tracing.instrument import Fibre, Instrument, Ring
    from halfspace_sss.tracing.tracer import trace

prefer_bundled_llvm()

__all__ = [
    "BSSRDF", "Fibre", "Instrument", "Layers", "Medium", "Ring", "bssrdf", "curves", "make_maps", "materials",
    "measure", "models", "neural", "register_model", "trace",
]  # fmt: skip

__getattr__, __dir__ = lazy_names(__name__, {
    "": ["materials", "measure", "neural"], "comparison.reflectance_curves": ["curves"], "interface.model": ["BSSRDF"],
    "maps.map_store": ["make_maps"], "physics.medium": ["Layers", "Medium"],
    "registry": ["bssrdf", "models", "register_model"], "tracing.instrument": ["Fibre", "Instrument", "Ring"],
    "tracing.tracer": ["trace"],
})  # fmt: skip
