"""Ratings: payoff tables, Davidson's model and its fit, intervals, ladders and sequential tests."""
