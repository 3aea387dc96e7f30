"""A policy that plays in another arena than it learnt in: what never moved there says nothing to it."""

from dataclasses import replace

import numpy as np
import pytest

import arenas
from agents.policy.constant_inputs import is_constant, silence_constant_inputs
from agents.policy.jax_policy import distribution, policy_params
from league.commands import cli
from league.config.experiment import Config, dumps
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runs.bench.evaluation import Request, evaluate
from league.runs.bench.tasks import find
from league.runtime.bootstrap import create
from league.snapshots import policy_file
from league.snapshots.codec import thaw
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.arena_transfer import changed_actions_of
from league.state.jobs import RatingMatch
from scripts.trained_cards import candidates
from storage.records import ArenaKey
from storage.store import Store

SCORE = policy_file.read(policy_file.find("anymal-score"))


@pytest.fixture(scope="module")
def pitch():
    return arenas.settings("soccer-1v1").build(engine="c", threads=1)


@pytest.fixture
def store(tmp_path, pitch):
    """A league of soccer-1v1 into which a policy was imported that learnt to score alone."""
    config = Config(arena=arenas.settings("soccer-1v1"))
    with Store.open(tmp_path / "store", create=True) as store:
        create(store, config, pitch)
        policy_file.bring_in(Open(store, "main"), SCORE, "scorer")
        yield store


def own(policy: policy_file.Policy) -> dict[str, np.ndarray]:
    return {name.removeprefix("0/"): array for name, array in policy.arrays.items()}


def scorer(store):
    return next(s for s in store.snapshots("main") if s.name == "scorer")


def test_elsewhere_what_never_moved_says_nothing_and_at_rest_nothing_changes(store, pitch):
    (here,), there = thaw(store, scorer(store), pitch), policy_params(own(SCORE))
    rests = is_constant(SCORE.arrays, "0/")
    seen = np.random.default_rng(0).normal(size=(64, rests.size)).astype(np.float32)
    seen[:, rests] = np.asarray(there["trunk.observation_mean"])[rests]
    np.testing.assert_allclose(distribution(here, seen)[0], distribution(there, seen)[0], atol=1e-5)
    moved = seen + 0.5 * rests.astype(np.float32)  # an enemy comes into sight
    np.testing.assert_allclose(distribution(here, moved)[0], distribution(here, seen)[0], atol=1e-6)
    assert np.abs(distribution(there, moved)[0] - distribution(there, seen)[0]).max() > 1.0


def test_where_it_learnt_a_policy_plays_as_it_is(store, pitch):
    learnt_here = replace(scorer(store), arena=ArenaKey("soccer-1v1", pitch.config_hash, "warp"))
    nobody_knows = replace(scorer(store), arena=None)
    for snapshot in (learnt_here, nobody_knows):
        (policy,) = thaw(store, snapshot, pitch)
        for name, array in own(SCORE).items():
            np.testing.assert_array_equal(policy[name], array, err_msg=name)


def test_a_referee_keeps_apart_what_learnt_here_and_elsewhere(store, pitch):
    evaluator = MatchEvaluator(Config(arena=arenas.settings("soccer-1v1")), pitch, "main")
    here = replace(scorer(store), arena=ArenaKey("soccer-1v1", pitch.config_hash, "c"))
    weights = [np.asarray(evaluator._load(store, s)[0]["trunk.hidden.0.weight"]) for s in (scorer(store), here)]
    assert np.abs(weights[0] - weights[1]).max() > 0.0


def test_behind_a_layer_norm_weights_stay():
    policy = own(SCORE) | {"trunk.norm.0.weight": np.ones(66, np.float32)}
    changed = silence_constant_inputs(policy)
    np.testing.assert_array_equal(changed["trunk.hidden.0.weight"], policy["trunk.hidden.0.weight"])
    assert set(changed["trunk.observation_var"][is_constant(policy)].tolist()) == {1.0}


def test_an_import_says_where_it_learnt_and_what_never_moved_there(store, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["import", "anymal-score", "--as", "guest", "--store", str(tmp_path / "store")])
    assert not ended.value.code
    still = int(is_constant(SCORE.arrays, "0/").sum())
    assert f"It learnt in soccer-score: {still} of its 66 inputs never moved there" in capsys.readouterr().out


def settings_with(drive_scale: float, **further) -> Config:
    """Settings of soccer-1v1 with that unit of throttle; the rovers that come with the league learnt with 10."""
    base = arenas.settings("soccer-1v1")
    return Config(arena=replace(base, rules=replace(base.rules, drive_scale=drive_scale)), **further)


@pytest.mark.parametrize(
    ("name", "drive_scale", "kinds"),
    [("leatherback-score", 40.0, ["leatherback"]), ("leatherback-score", 10.0, []), ("anymal-score", 40.0, [])],
)
def test_actions_that_mean_something_else_here_are_told(name, drive_scale, kinds):
    policy = policy_file.read(policy_file.find(name))
    told = list(changed_actions_of(policy, dumps(settings_with(drive_scale))))
    assert len(told) == len(kinds)
    for line, kind in zip(told, kinds, strict=True):
        assert f"An action of the {kind} means something else here than in soccer-score-leatherback" in line
        assert "throttle was speed of all wheels, 10 rad/s per unit" in line
        assert "and is speed of all wheels, 40 rad/s per unit" in line
        assert "steering" not in line


def test_of_an_arena_that_cannot_be_built_nothing_is_told():
    policy = policy_file.read(policy_file.find("leatherback-score"))
    assert not list(changed_actions_of(policy, '[arena]\nname = "not/there.py:Arena"'))


def test_a_new_league_names_the_source_whose_actions_change(tmp_path):
    config = settings_with(40.0, after=("anymal-score", "leatherback-score"))
    with Store.open(tmp_path / "store", create=True) as store:
        arena = config.arena.build(engine="c", threads=1)
        create(store, config, arena)
        (line,) = warm_start.changed_actions(store, config)
        assert line.startswith("leatherback-score: An action of the leatherback means something else")
        after = replace(config, league="later", after=("main",))
        create(store, after, arena)
        assert not warm_start.changed_actions(store, after)
        (line,) = warm_start.changed_actions(store, replace(after, arena=settings_with(20.0).arena))
    assert line.startswith("main: ")
    assert "was speed of all wheels, 40 rad/s per unit" in line


@pytest.mark.parametrize(
    ("rules", "rover"),
    [({}, "leatherback-soccer"), ({"drive_scale": 40.0, "steer_scale": 0.5}, "leatherback-soccer-preset")],
)
def test_the_rating_pool_has_those_whose_actions_mean_the_same(rules, rover, tmp_path):
    base = arenas.settings("soccer-1v1")
    config = Config(arena=replace(base, rules=replace(base.rules, **rules)))
    with Store.open(tmp_path / "store", create=True) as store:
        create(store, config, config.arena.build(engine="c", threads=1))
        brought = {s.name for s in store.snapshots("main") if s.origin == "imported"}
    assert brought == {"anymal-soccer", "anymal-soccer-preset", rover}


def test_an_entry_is_told_of_changed_actions_before_a_game_is_played():
    def tell(line):
        raise InterruptedError(line)

    words = ["blue=anymal-score", "red=leatherback-score"]
    with pytest.raises(InterruptedError, match=r"e1:red: An action of the leatherback .* 40 rad/s per unit"):
        evaluate(find("t3-soccer-1v1-v1"), words, Request(name="x", games=2), tell=tell)


@pytest.fixture(scope="module")
def arenas_of_cards():
    """Name of an arena -> policies that it accepts, as for their cards."""
    policies = {title: policy_file.read(policy_file.find(title)) for title in policy_file.trained()}
    return {title: fit for title, (_, fit) in candidates(policies).items()}


@pytest.mark.parametrize("name", policy_file.trained())
def test_a_card_has_every_arena_that_accepts_the_policy(name, arenas_of_cards):
    card = (policy_file.TRAINED / f"{name}.safetensors.md").read_text()
    accepting = [title for title, fit in arenas_of_cards.items() if name in fit]
    assert accepting
    for title in accepting:
        assert f"\n| {title} | " in card


@pytest.mark.slow
def test_who_learnt_to_score_alone_beats_who_learnt_so_too(store):
    """As it learnt, it lay on its back after 1.3 s: 14 of 16 matches were draws, and two lost."""
    config = Config(arena=arenas.settings("soccer-1v1"), engine="c")
    config = replace(config, rating=replace(config.rating, worlds=24, pairings=1, record=False))
    policy_file.bring_in(Open(store, "main"), policy_file.read(policy_file.find("leatherback-score")), "rover")
    evaluator = MatchEvaluator(config, config.arena.build(engine="c", worlds=24), "main")
    (match,) = evaluator.play(store, RatingMatch((("scorer", "rover"),), 1, record=False))
    assert (match.wins + match.draws / 2) / 24 > 0.6
