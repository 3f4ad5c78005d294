"""Studies: what is compared with the models that ship, and ships no product."""
