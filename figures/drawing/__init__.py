"""What figures draw: their style, images side by side, pages, curves and tables."""
