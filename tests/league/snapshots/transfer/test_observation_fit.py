"""Networks that go on by the parts of observations: the source of each input, and how such a policy acts at first."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import distribution
from agents.settings import Architecture
from arenas.description import Part
from league.config import experiment as configuration
from league.config import presets
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.runtime.bootstrap import create, players_of, validate_stage_starts
from league.runtime.checkpoint_compat import validate_start
from league.runtime.validation import validate
from league.scheduling import turn_scheduler
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.observation_fit import fit
from league.state.jobs import decode
from league.state.league_state import LeagueState
from league.training.learner_factory import new_learner
from league.training.learner_pool import LearnerPool
from league.training.turn_end import TurnFinalizer
from storage.blobs import arrays
from storage.errors import UnknownName
from storage.records import Checkpoint, Job
from storage.store import Store
from tests.agents.conftest import make_batch

SPEED, GOAL, BALL, TIME = Part("speed", 2), Part("goal", 3), Part("ball", 3), Part("time", 1)
RENAMED = tuple(f"enemy's {of}=enemy 0's {of}" for of in ("position", "bearing", "heading", "velocity", "margin"))


def test_parts_are_found_by_name_and_size_wherever_they_stand():
    found = fit([SPEED, GOAL, TIME], [TIME, BALL, SPEED, Part("time", 2)], ["*"])
    assert found is not None
    assert found.places.tolist() == [5, -1, -1, -1, 0, 1, -1, -1]
    assert (found.kept, found.new, found.lost) == (("time", "speed"), ("ball", "time"), ("goal",))
    assert str(found) == "they see: time, speed; new to them: ball, time; no longer seen: goal"


def test_a_part_with_another_name_takes_over_and_is_not_taken_twice():
    found = fit([SPEED, GOAL], [GOAL, BALL, SPEED], ["*", "goal=ball"])
    assert found is not None
    assert found.places.tolist() == [-1, -1, -1, 2, 3, 4, 0, 1]
    assert found.kept == ("goal as ball", "speed")


def test_parts_of_one_name_follow_their_order():
    found = fit([BALL, SPEED, BALL], [BALL, BALL], ["ball"])
    assert found is not None
    assert found.places.tolist() == [0, 1, 2, 5, 6, 7]


def test_only_named_parts_are_seen():
    found = fit([SPEED, GOAL, TIME], [SPEED, TIME, BALL], ["time"])
    assert found is not None
    assert found.places.tolist() == [-1, -1, 5, -1, -1, -1]


def test_an_equal_observation_needs_no_fit():
    assert fit([SPEED, GOAL], [SPEED, replace_meaning(GOAL)], ["gaol=ball"]) is None


def replace_meaning(part: Part) -> Part:
    return part._replace(meaning="somewhere else")


@pytest.mark.parametrize(
    ("named", "told"),
    [
        ("gaol=ball", "gaol: no part of the observation where it learnt has this name; it has speed, goal"),
        ("goal=bal", "bal: no part of the observation here has this name; it has speed, ball, time"),
        ("time", "time: no part of the observation where it learnt has this name; it has speed, goal"),
        ("speed=time", "speed=time: speed has 2 numbers where it learnt, and time has 1 numbers here"),
    ],
)
def test_a_part_that_is_not_there_or_has_another_size_is_refused(named, told):
    with pytest.raises(ValueError, match=f"^{told}$"):
        fit([SPEED, GOAL], [SPEED, BALL, TIME], [named])


# In leagues of rovers, one against one and then two against two ------------------------------------------------------


def rovers(preset: str, **learner):
    config = presets.preset(preset)
    own = replace(config.learner, architecture=Architecture((16, 16), **learner), normalise_observations=True)
    return replace(config, league=preset, learner=own)


@pytest.fixture(scope="module")
def arena_of():
    return {name: rovers(name).arena.build(engine="c", threads=1) for name in ("duel", "quickstart")}


@pytest.fixture
def learnt(tmp_path, arena_of, request):
    """A store with a league of rovers that have learnt one against one."""
    config = rovers("duel", **getattr(request, "param", {}))
    with Store.open(tmp_path / "store", create=True) as store:
        create(store, config, arena_of["duel"])
        checkpoints = []
        for player in store.players("duel"):
            learner = new_learner(config, arena_of["duel"], player)
            assert isinstance(learner, HappoLearner)
            learner.learn(make_batch(learner, seed=1))
            checkpoints.append(
                Checkpoint("duel", player.name, store.blobs.put(arrays.to_bytes(learner.save())), 48, 1, 1.0)
            )
        store.queue([Job("duel", "any", "made")])
        claimed = store.claim("duel", ["any"], "here", 60)
        assert claimed is not None
        store.finish(claimed[0], checkpoints=checkpoints)
        yield store


def two_a_side(**changes):
    return replace(rovers("quickstart"), after=("duel",), after_parts=("*", *RENAMED), **changes)


@pytest.mark.slow
def test_a_policy_acts_at_first_as_where_it_learnt_whatever_is_new_to_it(learnt, arena_of):
    config, arena, home = two_a_side(), arena_of["quickstart"], arena_of["duel"]
    players = players_of(config, arena)
    found = warm_start.of_config(learnt, players, config)[players[0].name]
    fitted = warm_start.fits_of(learnt, config, arena, players[0], found)
    assert found.critic is None
    learner = new_learner(config, arena, players[0])
    assert isinstance(learner, HappoLearner)
    assert warm_start.start(learnt, learner, found, fitted) == "duel/blue@1"
    seen = np.asarray(jax.vmap(arena.reset)(jax.random.split(jax.random.key(0), 4)).observations["blue/0"])
    parts = arena.observation_parts("blue/0")
    first = dict(zip([part.name for part in parts], np.cumsum([0, *(part.size for part in parts)]), strict=False))
    sees = [(first[part.name.replace("enemy's", "enemy 0's")], part.size) for part in home.observation_parts("blue/0")]
    other = np.concatenate([seen[:, at : at + size] for at, size in sees], axis=1)
    source = {k: v.numpy() for k, v in original(learnt, home).export()[0].items()}
    own = {k: v.numpy() for k, v in learner.export()[0].items()}
    for one, two in zip(distribution(own, seen), distribution(source, other), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-6)
    new = np.flatnonzero(fitted[0].places < 0)
    assert len(new) == seen.shape[1] - other.shape[1]
    counts = learner.save()["actor.0.observed"]
    assert set(counts[new].tolist()) == {0}
    assert set(np.delete(counts, new).tolist()) == {48}


def original(store, arena) -> HappoLearner:
    """The learner from which blue goes on."""
    learner = new_learner(rovers("duel"), arena, store.players("duel")[0])
    assert isinstance(learner, HappoLearner)
    learner.load(arrays.from_bytes(store.blobs.get(store.newest_checkpoints("duel")["blue"].digest)))
    return learner


def test_what_is_new_to_a_policy_moves_it_once_it_learns(learnt, arena_of):
    config, arena = two_a_side(), arena_of["quickstart"]
    player = players_of(config, arena)[0]
    found = warm_start.of_config(learnt, [player], config)[player.name]
    fitted = warm_start.fits_of(learnt, config, arena, player, found)
    learner = new_learner(config, arena, player)
    assert isinstance(learner, HappoLearner)
    warm_start.start(learnt, learner, found, fitted)
    learner.learn(make_batch(learner, seed=2))
    weights = learner.save()["actor.0.trunk.hidden.0.weight"]
    assert (weights[:, fitted[0].places < 0] != 0).all(axis=0).any()


def test_the_first_turn_of_a_league_makes_players_that_are_fitted(learnt, arena_of):
    config, arena = two_a_side(), arena_of["quickstart"]
    create(learnt, config, arena)
    players = learnt.players(config.league)
    (job,) = turn_scheduler.next_turns(config, LeagueState.of(learnt, config.league)).jobs
    pool = LearnerPool(config, arena, players)
    TurnFinalizer(pool, decode(job), learnt).begin(learnt)
    found = warm_start.of_config(learnt, players, config)
    for player in players:
        new = warm_start.fits_of(learnt, config, arena, player, found[player.name])[0].places < 0
        weights = pool.learners[player.name].save()["actor.0.trunk.hidden.0.weight"]
        assert (weights[:, new] == 0).all()
        assert (weights[:, ~new] != 0).any(axis=0).all()


def test_the_start_of_a_run_is_examined_and_told(learnt, arena_of):
    config, arena, where = two_a_side(), arena_of["quickstart"], str(Path(learnt.where).parent)
    validate_stage_starts(where, config, [(config, arena)])
    validate_start(learnt, config, arena, players_of(config, arena))
    create(learnt, config, arena)
    (line,) = warm_start.fit_lines(learnt, config, arena)
    assert line.startswith(
        "by parts of their observations go on blue/0, blue/1, red/0, red/1; they see: last throttle, "
    )
    assert "enemy's margin as enemy 0's margin; new to them: team-mate's position" in line


def test_networks_of_another_observation_are_refused_without_parts(learnt, arena_of):
    config = replace(two_a_side(), after_parts=())
    with pytest.raises(ConfigError, match=r"sees 38 numbers .* 20 numbers .* go on \(after_parts\)"):
        validate_stage_starts(str(Path(learnt.where).parent), config, [(config, arena_of["quickstart"])])


def test_a_wrong_part_is_refused_before_anything_runs(learnt, arena_of):
    config, arena = replace(two_a_side(), after_parts=("enemy=enemy 0",)), arena_of["quickstart"]
    told = r"^after_parts: leatherback of duel: enemy: no part of the observation where it learnt has this name; it has"
    with pytest.raises(ConfigError, match=told):
        validate_start(learnt, config, arena, players_of(config, arena))


def test_a_wrong_part_of_a_later_stage_is_refused_when_the_first_begins(tmp_path, arena_of):
    first, second = (
        replace(rovers("duel"), league="cup.one"),
        replace(two_a_side(), league="cup.two", after=("cup.one",)),
    )
    config = replace(rovers("duel"), league="cup", after_parts=("*", "enemy=enemy 0"))
    stages = [(first, arena_of["duel"]), (replace(second, after_parts=config.after_parts), arena_of["quickstart"])]
    with pytest.raises(ConfigError, match=r"after_parts: leatherback of cup\.one: enemy: no part"):
        validate_stage_starts(str(tmp_path / "none"), config, stages)
    stages[1] = (second, arena_of["quickstart"])
    validate_stage_starts(str(tmp_path / "none"), config, stages)


def test_a_player_of_a_stage_that_starts_from_nothing_needs_no_parts(tmp_path, arena_of):
    config, where = replace(rovers("duel"), league="cup"), str(tmp_path / "none")
    first = replace(config, league="cup.one"), arena_of["duel"]

    def from_these(blue, red):
        own = (PlayerSettings("blue", after=blue), PlayerSettings("red", after=red))
        second = replace(rovers("quickstart"), league="cup.two", after=("cup.one",), players=own)
        validate_stage_starts(where, config, [first, (second, arena_of["quickstart"])])

    from_these((), ())
    with pytest.raises(ConfigError, match=r"sees 38 numbers and acts with 2 here, and sees 20 .* in cup\.one"):
        from_these((), None)
    with pytest.raises(UnknownName, match="gone"):
        from_these((), ("gone",))


def test_in_the_preset_of_kick_and_defend_a_walker_becomes_the_kicker_and_then_both_players(tmp_path):
    config = presets.preset("kick-and-defend")
    stages = [configuration.stage(config, number) for number in range(len(config.stages))]
    built = [(stage, stage.arena.build(engine="c", threads=1)) for stage in stages]
    validate_stage_starts(str(tmp_path / "none"), config, built)
    walk, kick, full = (players_of(*each) for each in built)
    (walker,) = walk
    own = {player.name: [] for player in kick if player.role == "fixed"}
    assert warm_start.warm_starts(kick, [walk], any_size=True, own=own)["kicker"].actors[0].player == walker.name
    found = warm_start.warm_starts(full, [kick, walk], any_size=True)
    assert {start.actors[0].player for start in found.values()} == {"kicker"}


@pytest.mark.parametrize("learnt", [{"layer_norm": True}], indirect=True)
def test_a_network_that_normalises_its_inputs_together_cannot_go_on(learnt, arena_of):
    config, arena = two_a_side(), arena_of["quickstart"]
    with pytest.raises(ConfigError, match=r"normalises all its inputs together \(learner\.architecture\.layer_norm\)"):
        validate_start(learnt, config, arena, players_of(config, arena))
    own = replace(config, learner=replace(config.learner, architecture=Architecture((16, 16), layer_norm=True)))
    with pytest.raises(ConfigError, match=r"layer_norm = true: after_parts is for networks"):
        validate(own)


@pytest.mark.parametrize("text", ["", "=ball", "goal=", "a=b=c"])
def test_what_names_no_part_is_refused(text):
    with pytest.raises(ConfigError, match=r'is no part: give its name, "THERE=HERE"'):
        configuration.loads(f"after_parts = ['{text}']")
