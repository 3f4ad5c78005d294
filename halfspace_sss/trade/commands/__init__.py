"""The commands `trade` and `trade-check`."""
