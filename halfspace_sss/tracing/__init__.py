"""The random walk in the half-space and what is tallied from it."""
