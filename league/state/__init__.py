"""The state of a league, read from its store as values, and the jobs that change it."""
