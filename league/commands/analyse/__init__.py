"""Commands that answer questions about arenas, ratings and payoffs."""
