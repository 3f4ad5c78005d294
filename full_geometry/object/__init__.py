"""Geometry and light of one object: first event, features, surroundings, patches, walks, pairs and radiance."""
