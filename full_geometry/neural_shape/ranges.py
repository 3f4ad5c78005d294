"""What the network of all shapes is trained on, and warns outside of."""

__all__ = ["ALBEDO", "ETA", "SIZE", "G"]

SIZE = (1.0, 3000.0)  # sigma_t sqrt(area)
ALBEDO, G, ETA = (0.02, 1.0), (-0.3, 0.95), (1.0, 1.7)  # the albedo reduced
