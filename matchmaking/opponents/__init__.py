"""Opponents of a learning player: win rates in, probabilities out. Pure functions and values; NumPy alone.

`rules` has the published rules, `records` the win rates and quality scores that they read, `settings` the league's
configuration of them. Lists of snapshots are ordered from oldest to newest.
"""

from matchmaking.opponents.records import Qualities, WinRecord, WinRecords
from matchmaking.opponents.rules import (
    Mixture,
    Weighting,
    alphastar,
    by_quality,
    delta_uniform,
    draw,
    exploit,
    gaussian,
    latest,
    pfsp,
    uniform,
)
from matchmaking.opponents.settings import Kind, Opponents, Split

__all__ = [
    "Kind",
    "Mixture",
    "Opponents",
    "Qualities",
    "Split",
    "Weighting",
    "WinRecord",
    "WinRecords",
    "alphastar",
    "by_quality",
    "delta_uniform",
    "draw",
    "exploit",
    "gaussian",
    "latest",
    "pfsp",
    "uniform",
]  # fmt: skip
