"""Commands that answer questions about ratings, payoffs and several leagues."""
