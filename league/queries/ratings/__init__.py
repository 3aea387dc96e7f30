"""Ratings tables, payoff tables and their notes."""
