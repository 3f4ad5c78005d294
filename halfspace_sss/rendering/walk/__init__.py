"""The random walk inside an object: the reference of images."""
