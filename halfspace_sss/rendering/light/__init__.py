"""Emitters of a scene that are sampled one by one: lamps, delta lights, and suns in the sky."""
