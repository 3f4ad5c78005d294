"""Models beside path tracing: curves, published truths, speed, and errors over media."""
