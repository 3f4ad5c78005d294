"""Where light enters an object for an exit, and what it is worth there."""
