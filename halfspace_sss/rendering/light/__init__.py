"""Emitters of a scene that have to be aimed at: lamps, delta lights, and suns in the sky."""
