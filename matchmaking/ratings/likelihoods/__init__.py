"""Likelihoods of games with a prior: their information matrices, covariances, and sets of alternatives."""
