"""The integrators `bssrdf` and `translucent_walk`."""
