"""The paper's own full geometry: a network from N incident samples to radiance, and its flow in space.

Read literally, for its figures and as a baseline; trained here for as long as is stated, so never the authors'
converged results. The N points of training are ends of walks, which are spread like S itself: the network learns
mean(T) mean(L) and is right where its points come from walks.
"""
