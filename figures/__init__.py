"""One file per figure of the paper, `compute()` apart from `draw()`."""
