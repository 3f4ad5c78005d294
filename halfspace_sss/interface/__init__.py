"""What every half-space model answers, and the registry of models by name."""
