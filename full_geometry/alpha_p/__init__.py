"""S = alpha p: the share of light that comes back at an exit times a density of where and from where it came."""
