"""The policies that come with the league do what their cards say, on the engine of a CPU too."""

from dataclasses import replace

import pytest

from league import exchange
from league.config import experiment as configuration
from league.create import create
from league.evaluate import Referee
from league.jobs import RatingMatch
from storage.store import Store

MET = {
    "anymal-walk": (None, 0.9), "anymal-push": ("idle", 0.75), "leatherback-push": ("idle", 0.85),
    "anymals-sumo": ("pusher:red", 0.7), "leatherbacks-sumo": ("trot:blue", 0.7),
    "anymal-score": (None, 0.08), "leatherback-score": (None, 0.4),
    "anymal-ball": (None, 0.9), "minitank-aim": (None, 0.9), "crazyflie-fly": (None, 0.9),
    "minitank-galaga": ("dodger:red", 0.9), "crazyflie-galaga": ("random:blue", 0.85),
}  # fmt: skip
"""Against whom, and at least which score."""
SIGHT = {name: {"rich": True, "buffer": 8} for name in ("minitank-galaga", "crazyflie-galaga")}
"""Settings of the arena without which they do not fit."""


def test_each_is_tried():
    assert MET.keys() == set(exchange.trained())


@pytest.mark.slow
@pytest.mark.parametrize("name", MET)
def test_it_plays_as_it_learnt(name, tmp_path):
    opponent, asked = MET[name]
    about = exchange.read(exchange.find(name)).about
    config = configuration.default(about["arena"]["arena"])
    config = replace(config, arena=replace(config.arena, **SIGHT.get(name, {})))
    config = replace(config, rating=replace(config.rating, worlds=128, pairings=1, record=False))
    arena = config.arena.build(engine="c", worlds=128)
    with Store.open(tmp_path, create=True) as store:
        create(store, config, arena)
        (match,) = Referee(config, arena, config.league).play(store, RatingMatch(((name, opponent),), 1, record=False))
    episodes = match.wins + match.draws + match.losses
    assert episodes == 128
    assert (match.wins + match.draws / 2) / episodes > asked
