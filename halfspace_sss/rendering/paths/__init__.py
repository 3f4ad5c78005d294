"""Paths through a scene: the loop, what happens at a surface, and the integrator `bssrdf`."""
