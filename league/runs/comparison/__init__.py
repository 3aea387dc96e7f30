"""Comparison of leagues: cells, curves with bands, one ladder by cross-play, the page."""
