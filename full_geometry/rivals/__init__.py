"""Rivals at equal time: ways of drawing entries, and models of one object."""
