"""Shapes and points of their surfaces, without any medium: rays, instances, sensors, what changed since."""
