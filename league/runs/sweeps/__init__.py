"""Sweeps: their files, their work, searches."""
