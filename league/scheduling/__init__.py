"""Scheduling: which turns and matches come next, computed from the league's state alone."""
