"""A file of materials that several tests read."""

FILE = """
set = "mine"
unit = "1/cm"
eta = 1.4
source = "own measurement"
channels = ["R", "G", "B"]

[[material]]
name = "soap"
sigma_s_prime = [13.0, 14.0, 16.0]
sigma_a = [0.1, 0.2, 0.4]

[[material]]
name = "wax"
sigma_s = 10.0
sigma_a = [0.1, 0.2, 0.4]
g = [0.5, 0.0, -0.5]
"""
