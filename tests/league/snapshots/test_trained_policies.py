"""The policies that come with the league do what their cards say, on the engine of a CPU too."""

from dataclasses import replace

import pytest

from league.config import experiment as configuration
from league.matches.evaluator import MatchEvaluator
from league.runtime.bootstrap import create
from league.snapshots import policy_file
from league.state.jobs import RatingMatch
from storage.store import Store

MET = {
    "anymal-walk": (None, 0.9), "anymal-push": ("idle", 0.75), "leatherback-push": ("idle", 0.85),
    "anymals-sumo": ("pusher:red", 0.7), "leatherbacks-sumo": ("trot:blue", 0.7),
    "anymal-leatherback-sumo": ("idle", 0.8),
    "anymal-score": (None, 0.08), "leatherback-score": (None, 0.4),
    "anymal-soccer": ("idle:red", 0.8), "leatherback-soccer": ("idle:blue", 0.7),
    "leatherback-score-preset": (None, 0.5), "anymal-soccer-preset": ("idle:red", 0.8),
    "leatherback-soccer-preset": ("idle:blue", 0.7),
    "anymal-ball": (None, 0.9), "minitank-aim": (None, 0.9), "crazyflie-fly": (None, 0.9),
    "minitank-galaga": ("dodger:red", 0.9), "crazyflie-galaga": ("random:blue", 0.85),
    "minitanks-galaga": ("dodger:red", 0.8), "crazyflies-galaga": ("random:blue", 0.8),
}  # fmt: skip
"""Against whom, and at least which score."""
SIGHT = {name: {"rich": True, "buffer": 8} for name in ("minitank-galaga", "crazyflie-galaga")}
SIGHT |= {name: {"rich": True, "buffer": 14} for name in ("minitanks-galaga", "crazyflies-galaga")}
"""Settings of the arena without which they do not fit."""
RULES = {name: {"ray": 0.5} for name in ("minitanks-galaga", "crazyflies-galaga")}
RULES |= {f"leatherback-{of}-preset": {"drive_scale": 40.0, "steer_scale": 0.5} for of in ("score", "soccer")}
"""Those of the game that they learnt."""


def test_each_is_tried():
    assert MET.keys() == set(policy_file.trained())


# One of each kind of robot, and a whole team; the others, and more episodes, on a GPU host.
IN_CI = {"anymal-walk", "leatherback-push", "minitank-aim", "crazyflie-fly", "leatherbacks-sumo"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in IN_CI else pytest.mark.gpu) for name in MET]
)
def test_it_plays_as_it_learnt(name, tmp_path):
    opponent, asked = MET[name]
    worlds = 32 if name in IN_CI else 128
    about = policy_file.read(policy_file.find(name)).about
    config = configuration.default(about["arena"]["arena"])
    rules = replace(config.arena.rules, **RULES.get(name, {}))
    config = replace(config, arena=replace(config.arena, rules=rules, **SIGHT.get(name, {})))
    config = replace(config, rating=replace(config.rating, worlds=worlds, pairings=1, record=False))
    arena = config.arena.build(engine="c", worlds=worlds)
    with Store.open(tmp_path, create=True) as store:
        create(store, config, arena)
        (match,) = MatchEvaluator(config, arena, config.league).play(
            store, RatingMatch(((name, opponent),), 1, record=False)
        )
    episodes = match.wins + match.draws + match.losses
    assert episodes == worlds
    assert (match.wins + match.draws / 2) / episodes > asked
