"""The parts of a figure: what they are, where they are kept, and when they are computed again."""
