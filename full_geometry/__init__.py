"""The full-geometry model: a network that takes one exit point and N incident samples."""
