"""The leagues that a comparison is about, and their cells."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from league.config import experiment
from league.config.experiment import Config, default
from league.config.stages import Stage
from league.matches.exploitability import attack, begin
from league.queries.query import Open
from league.runs.comparison.cells import cells, members
from league.runtime.bootstrap import create
from storage.errors import UnknownName
from storage.records import League
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


def write(store: Store, *configs: Config) -> None:
    for config in configs:
        store.create_league(League(config.league, experiment.dumps(config)))


def test_leagues_that_start_from_other_policies_are_other_cells(tmp_path: Path):
    starts = {"none": (), "push": ("anymal-push",), "file": ("my/policy.safetensors",)}
    with Store.open(tmp_path, create=True) as store:
        write(store, *(of(f"go.{n}.s{seed}", seed, after=after) for n, after in starts.items() for seed in (1, 2)))
        assert found(store, "go.*") == [[f"go.{name}.s1", f"go.{name}.s2"] for name in starts]


def test_a_forerunner_of_a_leagues_own_seed_makes_no_other_cell(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        write(store, *(of(f"stand.s{seed}", seed) for seed in (1, 2)))
        write(store, *(of(f"walk.s{seed}", seed, 1e-4, (f"stand.s{seed}",)) for seed in (1, 2)))
        write(store, *(of(f"go.s{seed}", seed, after=(f"walk.s{seed}/blue@4",)) for seed in (1, 2)))
        write(store, *(of(f"from-{n}.s{seed}", seed, after=(f"walk.s{n}",)) for n in (1, 2) for seed in (1, 2)))
        write(store, of("walk-again.s1", 1, 1e-4, ("stand.s1",)), of("go-again.s1", 1, after=("walk-again.s1/blue@4",)))
        assert found(store, "go.*") == [["go.s1", "go.s2"]]
        assert found(store, "from-*") == [[f"from-{n}.s1", f"from-{n}.s2"] for n in (1, 2)]
        assert found(store, "go.s1", "go-again.s1") == [["go.s1"], ["go-again.s1"]]


def test_stages_of_a_leagues_own_curriculum_make_no_other_cell(tmp_path: Path):
    stages = (Stage("walk", {"budget": {"steps": 1000}}), Stage("match", {}))
    with Store.open(tmp_path, create=True) as store:
        for seed in (1, 2):
            config = replace(of(f"go.s{seed}", seed), stages=stages)
            write(store, config, *(experiment.stage(config, number) for number in range(2)))
        assert found(store, "go.*") == [["go.s1", "go.s2"]]
