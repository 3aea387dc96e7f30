"""Who should meet whom, and who is better: pure functions of the match log, in numpy."""
