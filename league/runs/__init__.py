"""Leagues run from Python, and many leagues: a run in a process of its own, sweeps, comparisons."""
