"""Commands that start, stop and follow a league."""
