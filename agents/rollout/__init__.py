"""Rollouts and matches of policies in arenas, in JAX, and the metrics of what was played."""
