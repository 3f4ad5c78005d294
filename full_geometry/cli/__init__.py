"""Commands on scenes: render, fit, trade, train and errors."""
