"""Robots, one per file: bodies built from numbers with units and sources."""
