"""Policies: networks in torch, and the same weights as functions in JAX."""
