"""The game of choosing a snapshot: Nash and alpha-rank mixtures of a payoff table."""
