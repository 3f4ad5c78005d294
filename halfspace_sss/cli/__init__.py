"""Commands of the plane, one file each: curves, maps, bench, validate, lists of materials and models."""
