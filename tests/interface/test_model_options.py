"""Options of the analytic models: bad ones are refused, good ones survive a change of medium."""

from __future__ import annotations

import pytest

from analytic_models.better_dipole import BetterDipole
from analytic_models.forward_scattering_dipole import ForwardScatteringDipole
from analytic_models.photon_beam_diffusion import PhotonBeamDiffusion
from halfspace_sss import Medium

MEDIA = [Medium(1.8075, 0.6025, 0.0, 1.3), Medium.from_albedo(0.9984, 2.6, 0.0, 1.5)]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda m: PhotonBeamDiffusion(m, n_samples=1), "n_samples must be an integer in"),
        (lambda m: PhotonBeamDiffusion(m, kappa="half"), "kappa must be one of"),
        (lambda m: BetterDipole(m, moments="fitted"), "moments must be one of"),
        (lambda m: ForwardScatteringDipole(m, n_samples=2.5), "n_samples must be an integer in"),
        (lambda m: ForwardScatteringDipole(m, virtual_source="none"), "virtual_source must be one of"),
        (lambda m: ForwardScatteringDipole(Medium(1.0, 0.1, -0.2, 1.3)), "g must be >= 0 .* got -0.2"),
    ],
)
def test_bad_options_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build(MEDIA[0])


def test_options_survive_a_change_of_medium():
    other = PhotonBeamDiffusion(MEDIA[0], n_samples=8, kappa="none", moments="published").for_medium(MEDIA[1])
    assert (other.n_samples, other.kappa, other.moments) == (8, "none", "published")
    assert (
        ForwardScatteringDipole(MEDIA[0], virtual_source="grosjean").for_medium(MEDIA[1]).virtual_source == "grosjean"
    )
