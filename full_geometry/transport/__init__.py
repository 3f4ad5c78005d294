"""S on objects: half-space models, mixtures for textures, lambert, the network of one object, that of all shapes."""
