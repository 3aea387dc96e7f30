"""Robot League's matchmaking: opponents, matches and ratings as pure functions of the match log, in NumPy."""
