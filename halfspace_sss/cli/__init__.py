"""Commands of the plane, one file each: curves, maps, validate, lists of materials and models."""
