"""Processes of a running league: preflight, manager, workers."""
