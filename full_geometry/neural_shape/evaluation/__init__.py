"""How wrong the network of all shapes is, on what it has not been trained on."""
