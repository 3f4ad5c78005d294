"""What ways of drawing entries cost: variance of a sample times its time, under several kinds of light."""
