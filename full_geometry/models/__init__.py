"""What is known of S of an object: what one object has learnt, the network of all shapes, files of weights."""
