"""A league of rock, paper, scissors in a store of its own, for tests of players with other learners."""

import pytest

import arenas
from league.snapshots.codec import add_scripts
from tests.league.turns import LEAGUE, new_store


@pytest.fixture(scope="module")
def game():
    return arenas.settings("rock-paper-scissors").build(engine="c", threads=1)


@pytest.fixture
def store(tmp_path, game):
    with new_store(tmp_path / "store", game) as store:
        add_scripts(store, LEAGUE, game, None)
        yield store
