"""Light known before the first sample: unscattered light inside objects, and light gathered on their surfaces."""
