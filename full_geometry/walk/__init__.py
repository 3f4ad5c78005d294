"""The random walk inside an object, connected to emitters."""
