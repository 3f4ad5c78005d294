"""Learning S of one object: walks as data, the likelihood, the fit, and how wrong the result is."""
