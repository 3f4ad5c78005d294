"""Translucent objects of a scene with what lies inside them, and the emitters that are sampled one by one."""
