"""The optics of a medium and its boundary: coefficients, Fresnel, phase function, single scattering."""
