"""Recordings of matches as MCAP files, and what can be read of damaged ones."""
