"""A league of equal robots on sides that are unlike, and leagues that were made before arenas said so."""

from dataclasses import replace
from pathlib import Path

import pytest

import arenas
from agents.policy.networks import Actor
from agents.settings import Architecture
from arenas.contract.check import FOUND
from arenas.contract.check import examine as checked
from league.commands import cli
from league.config import presets
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.matches.adhoc_matches import pairing
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.queries.ratings.rating_rows import side_text, unlike_sides
from league.runtime.bootstrap import create
from league.runtime.validation import validate
from league.scheduling.progress_metrics import can_meet, initial_opponents
from league.snapshots.codec import freeze
from league.snapshots.policy_file import bring_in, export
from league.state.jobs import RatingMatch
from league.state.team_exchange import as_made, players_in
from league.system.arena_build import build
from matchmaking.ratings.ladder import Pool
from storage.errors import StorageError
from storage.records import League, Player, Snapshot
from storage.store import Store

TAG = f"{Path(__file__).parents[2] / 'arenas' / 'chase.py'}:tag"


def settings(league="main"):
    config = Config(arena=arenas.settings(TAG), league=league)
    return replace(config, rating=replace(config.rating, worlds=32, pairings=2, trained=False, record=False))


@pytest.fixture(scope="module")
def arena():
    return build(settings(), 32)


@pytest.fixture
def store(tmp_path, arena):
    with Store.open(tmp_path / "store", create=True) as made:
        create(made, settings(), arena)
        yield made


@pytest.fixture
def old(tmp_path):
    """A league in that arena as versions made it that took equal rosters for exchangeable teams."""
    with Store.open(tmp_path / "old", create=True) as made:
        made.create_league(League("main", ""))
        made.add_players([Player("main", team, i, "main", "player:1:1") for i, team in enumerate(("chaser", "runner"))])
        yield made


def test_sides_that_are_unlike_are_not_swapped(store, arena):
    chaser, runner = store.players("main")
    assert (chaser.roster, runner.roster) == ("player:1:1@chaser", "player:1:1@runner")
    task = RatingMatch((("left:chaser", "left:runner"), ("left:chaser", "right:runner")), seed=3)
    caught, missed = MatchEvaluator(settings(), arena, "main").play(store, task)
    assert (caught.wins, caught.losses, caught.side_wins) == (16, 0, 16)  # the chaser has played no other side
    assert (missed.wins, missed.losses, missed.side_losses) == (0, 16, 16)
    assert sum(caught.pairs) == 0


def test_two_of_one_side_never_meet_and_progress_is_told_by_the_other_side(store):
    players = store.players("main")
    known = {s.name: s for s in store.snapshots("main")}
    assert not can_meet(known["left:chaser"], known["right:chaser"], players)
    assert can_meet(known["left:chaser"], known["right:runner"], players)
    begun = [Snapshot("main", f"{p.name}@0", p.name, p.roster, p.name, initial=True) for p in players]
    assert [s.name for s in initial_opponents(replace(begun[0], name="chaser@9"), begun, players)] == ["runner@0"]


def test_each_side_has_a_ladder_of_its_own_by_its_name(store):
    assert list(map(side_text, unlike_sides(store.players("main")))) == ["1 × player (chaser)", "1 × player (runner)"]
    pool = Pool.of(store.snapshots("main"), store.players("main"))
    assert set(pool.populations.values()) == {"player:1:1@chaser", "player:1:1@runner"}


def test_a_gate_between_the_sides_is_refused(store, tmp_path, capsys):
    found = pairing(Open(store, "main"), "left:chaser", "left:runner")
    assert not found.swaps
    with pytest.raises(SystemExit) as ended:
        cli.main(["gate", "left:chaser", "left:runner", "--store", str(tmp_path / "store")])
    assert ended.value.code == 2
    assert "cannot swap sides" in capsys.readouterr().err


def test_a_league_made_before_goes_on_with_exchangeable_teams(old, tmp_path):
    players = old.players("main")
    assert len({team.roster for team in build(settings(), 32, players).teams}) == 1
    arena = validate(settings(), players_in(str(tmp_path / "old"), None, "main"))
    create(old, settings(), arena)  # refuses players that contradict those that are there
    left, right = (s for s in old.snapshots("main") if s.script in ("left", "right"))
    assert MatchEvaluator(settings(), arena, "main").side_orders(left, right) == ((left, right), (right, left))


def test_leagues_of_unlike_teams_or_of_one_are_left_as_they_are(arena):
    own = [Player("main", p, i, "main", f"player:1:1@{p}") for i, p in enumerate(("chaser", "runner"))]
    for players in (own, own[:1], []):
        assert not as_made(arena, players).exchangeable


def test_a_policy_of_one_side_is_not_taken_for_the_other(store, tmp_path):
    parameters = Actor(1, 1, Architecture(hidden=(4,)), 0.8).state_dict()
    frozen = store.blobs.put(freeze([{name: tensor.numpy() for name, tensor in parameters.items()}]))
    store.add_snapshots([Snapshot("main", "runner@1", frozen, "player:1:1@runner", "runner")])
    policy = export(Open(store, "main"), "runner@1")
    with Store.open(tmp_path / "away", create=True) as away:
        create(away, settings(), build(settings(), 32))
        assert bring_in(Open(away, "main"), policy, "guest").roster == "player:1:1@runner"
        plain = policy._replace(about={**policy.about, "roster": "player:1:1"})
        with pytest.raises(StorageError, match=r"is for player:1:1, and league 'main'.* has player:1:1@chaser"):
            bring_in(Open(away, "main"), plain, "other")


NINE = """
from dataclasses import dataclass
from tests.arenas.chase import Tag
from arenas.arena import Arena
from arenas.arena_settings import Timing
from arenas.robots.robot import Robot


class Nine(Tag):
    def __init__(self, settings, **where):
        Arena.__init__(self, "nine", dict.fromkeys("abcdefghi", (Robot("player", 1),)), Timing(), {}, **where)


@dataclass(frozen=True)
class Settings:
    name: str = "nine"

    def build(self, **where):
        return Nine(self, **where)


ARENAS = (Settings(),)
"""


def test_nine_teams_are_refused_by_the_check_and_by_a_run(tmp_path):
    file = tmp_path / "nine.py"
    file.write_text(NINE)
    (result,) = checked(f"{file}:nine")
    assert result[:2] == (FOUND, False)
    assert "9 teams (a, b, c, d, e, f, g, h, i): an arena has at most 8; leave some out" in result.detail
    with pytest.raises(ConfigError, match=r"^9 teams \(a, b, c, d, e, f, g, h, i\): an arena has at most 8") as no:
        validate(Config(arena=arenas.settings(f"{file}:nine")))
    assert "\n" not in no.value.message


def test_a_batch_of_rating_matches_needs_a_world_for_each_seating():
    config = presets.preset("tag")
    config = replace(config, rating=replace(config.rating, worlds=4, pairings=2), engine="c")
    with pytest.raises(
        ConfigError, match=r"rating\.worlds = 4: each of 2 lineups needs a world for each of 3 seatings"
    ):
        validate(config)
