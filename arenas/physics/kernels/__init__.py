"""Warp's kernels before an engine's first step: which it needs, their compilation and loading, and its progress."""
