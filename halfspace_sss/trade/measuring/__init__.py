"""What is measured: ways of rendering, points that are seen, samples against the clock, unbiased squares."""
