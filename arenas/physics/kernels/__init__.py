"""Warp's kernels before an engine's first step: their list, their compilation and loading, and its progress."""
