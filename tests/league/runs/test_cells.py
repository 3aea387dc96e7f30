"""The leagues that a comparison is about, and their cells."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from league.config import experiment
from league.config.experiment import Config, default
from league.matches.exploitability import attack, begin
from league.queries.query import Open
from league.runs.comparison.cells import cells, members
from league.runtime.bootstrap import create
from storage.errors import UnknownName
from storage.store import Store


def of(league: str, seed: int = 1, lr: float = 1e-3, after: tuple[str, ...] = ()) -> Config:
    config = default("rock-paper-scissors")
    return replace(config, league=league, seed=seed, learner=replace(config.learner, lr=lr), after=after)


def found(store: Store, *names: str) -> list[list[str]]:
    """Return the names of the leagues in each cell."""
    with ExitStack() as until:
        return [[member.name for member in cell.members] for cell in cells(members(names, None, store, until))]


def test_a_pattern_leaves_out_attacks_unless_it_names_them(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        for seed in (1, 2):
            config = of(f"lr.s{seed}", seed)
            create(store, config, config.arena.build())
        chosen = attack(Open(store, "lr.s1"), "paper", experiment.Budget(steps=1000))
        begin(store, chosen)
        name = chosen.config.league
        assert found(store, "lr.*") == [["lr.s1", "lr.s2"]]
        assert found(store, "lr.s1", name) == [["lr.s1"], [name]]
        assert found(store, "lr.s1.exploit.*") == [[name]]
        with pytest.raises(UnknownName):
            found(store, "*.paper")
