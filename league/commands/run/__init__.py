"""Commands that start, stop and follow leagues."""
