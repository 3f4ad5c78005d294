"""Objects that figures learn: a training is a part of its own, and its weights are its result."""
