"""What a scene says of a translucent object: its material and model, its shape."""
