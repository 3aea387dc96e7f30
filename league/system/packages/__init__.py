"""Packages: the versions of those that count for results, and those that have our names."""
