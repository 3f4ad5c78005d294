"""Published analytic models of the half-space BSSRDF, one per file; a model joins by one line in the list."""

from analytic_models.better_dipole import BetterDipole
from analytic_models.directional_dipole import DirectionalDipole
from analytic_models.forward_scattering_dipole import ForwardScatteringDipole
from analytic_models.normalized_diffusion import NormalizedDiffusion
from analytic_models.photon_beam_diffusion import PhotonBeamDiffusion
from analytic_models.standard_dipole import StandardDipole, StandardDipoleNormalized
from halfspace_sss.interface.model import BSSRDF

__all__ = ["MODELS"]

MODELS: list[type[BSSRDF]] = [
    StandardDipole,
    StandardDipoleNormalized,
    BetterDipole,
    DirectionalDipole,
    PhotonBeamDiffusion,
    NormalizedDiffusion,
    ForwardScatteringDipole,
]
