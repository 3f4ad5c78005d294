"""The parts of a figure: what they are, where they are kept, when they are computed again; and the command for it."""
