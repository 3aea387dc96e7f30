"""Worlds that live on from one rollout to the next: how they begin, what is counted, and who pays for a broken one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.bridge import team_batch, to_jax
from agents.errors import Diverged
from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import stack_policies
from agents.rollout.metrics import episode_results, rollout_metrics
from agents.rollout.new_worlds import make_reset, make_restart
from agents.rollout.rollout import Trajectory, scripts_for
from agents.settings import Architecture, HappoConfig
from arenas.physics.void_causes import Cause

N, GROUPS = 30, 5
KEYS = jax.random.split(jax.random.key(3), N)


@pytest.fixture(scope="module")
def collect(short_sumo, short_rollout, scramble):
    """A rollout in which each team is one script, or whichever policy is given."""
    numbers = list(scripts_for(short_sumo, "leatherback"))
    shapes = to_jax(
        [scramble(0, a).state_dict() for a in (Architecture((8,), "elu"), Architecture((24, 5), layer_norm=True))]
    )

    def run(worlds, blue, red="idle"):
        who = [numbers.index(x) if isinstance(x, str) else x for x in (blue, red)]
        stacks = {
            f"{team}/0": stack_policies([x] * GROUPS, [*shapes, 0])
            for team, x in zip(("blue", "red"), who, strict=True)
        }
        worlds, trajectory = short_rollout(stacks, worlds, jax.random.key(1))
        return jax.device_get(worlds), jax.device_get(trajectory)

    return run


@pytest.fixture(scope="module")
def reset(short_sumo):
    return make_reset(short_sumo)


@pytest.fixture(scope="module")
def comm(short_sumo, collect) -> Trajectory:
    return collect(make_reset(short_sumo, stagger=False)(KEYS), "idle")[1]


def ends(trajectory: Trajectory) -> np.ndarray:
    return trajectory.terminated | trajectory.truncated | trajectory.void


def test_first_episodes_are_cut_at_decisions_spread_evenly_and_no_later_ones(short_sumo, reset, collect, comm):
    worlds = reset(KEYS)
    left = np.asarray(worlds.left)
    longest = short_sumo.timing.decisions
    assert 1 <= left.min() < longest / 4 < 3 * longest / 4 < left.max() <= longest
    natural = 1 + ends(comm).argmax(axis=0)  # the same worlds, whose first episodes were left to themselves
    assert not comm.cut.any()

    after, trajectory = collect(worlds, "idle")
    cut_first = left < natural
    assert 5 < cut_first.sum() < N - 1
    np.testing.assert_array_equal(1 + ends(trajectory).argmax(axis=0), np.minimum(left, natural))
    np.testing.assert_array_equal(trajectory.cut.sum(axis=0), cut_first)
    assert trajectory.truncated[trajectory.cut].all()
    assert not (trajectory.terminated | trajectory.void)[trajectory.cut].any()
    assert (after.left == 0).all()


def test_episodes_count_once_their_world_has_run_for_the_longest(short_sumo, reset, collect):
    longest = short_sumo.timing.decisions
    worlds, trajectory = collect(reset(KEYS), "idle")
    assert len(trajectory.settled) > longest
    assert not trajectory.settled[:longest].any()
    assert trajectory.settled[longest:].all()
    assert not trajectory.cut[longest:].any()
    where = np.arange(N) % 3 == 0
    fresh = make_restart(short_sumo)(jax.tree.map(jnp.asarray, worlds), KEYS, jnp.asarray(where))
    np.testing.assert_array_equal(fresh.unsettled, np.where(where, longest, 0))
    assert not make_reset(short_sumo, settle=False)(KEYS).unsettled.any()


def test_the_age_of_an_episode_counts_its_decisions(short_sumo, reset, collect):
    after, trajectory = collect(reset(KEYS), "random")
    age = np.zeros(N, int)
    for t, over in enumerate(ends(trajectory)):
        age += 1
        np.testing.assert_array_equal(trajectory.age[t], age)
        age[over] = 0
    np.testing.assert_array_equal(after.age, age)
    assert trajectory.age.max() <= short_sumo.timing.decisions


def test_a_restart_begins_chosen_worlds_anew_and_leaves_the_others_alone(short_sumo, reset, collect):
    played, _ = collect(reset(KEYS), "random")
    played = played._replace(events={name: np.ones_like(happened) for name, happened in played.events.items()})
    where, keys = np.arange(N) % 3 == 0, jax.random.split(jax.random.key(9), N)
    fresh = jax.device_get(reset(keys))
    begun = jax.device_get(make_restart(short_sumo)(jax.tree.map(jnp.asarray, played), keys, jnp.asarray(where)))
    for agent in ("blue/0", "red/0"):
        seen = begun.state.observations[agent]
        np.testing.assert_allclose(seen[where], fresh.state.observations[agent][where], atol=1e-5)
        np.testing.assert_array_equal(seen[~where], played.state.observations[agent][~where])
    np.testing.assert_array_equal(begun.age, np.where(where, 0, played.age))
    assert begun.events
    for happened in begun.events.values():
        np.testing.assert_array_equal(happened, np.stack([~where, ~where], axis=1))
    np.testing.assert_array_equal(begun.left, np.where(where, fresh.left, 0))
    np.testing.assert_array_equal(begun.state.physics.qpos[~where], played.state.physics.qpos[~where])


def test_a_rollout_is_compiled_once_whoever_sits_and_wherever_it_comes_from(reset, collect, scramble, caplog):
    collect(reset(KEYS), "idle")
    (policy,) = to_jax([scramble(7, Architecture((24, 5), layer_norm=True)).state_dict()])
    with jax.log_compiles(), caplog.at_level("WARNING"):
        collect(reset(KEYS), policy)
        assert "jit(rollout)" not in caplog.text
        jax.jit(lambda x: x + 1)(np.ones(3))
    assert "jit(<lambda>)" in caplog.text


def test_a_policy_that_is_not_finite_breaks_its_worlds_is_blamed_and_noticed(short_sumo, reset, collect):
    learner = HappoLearner([20], [2], HappoConfig(Architecture((8,), "elu")), seed=0)
    learner.actors[0].mean.bias.data.fill_(np.nan)
    (broken,) = to_jax(learner.export())
    trajectory = collect(reset(KEYS), broken)[1]
    assert trajectory.void.all()
    assert trajectory.at_fault[..., 0].all()
    assert not trajectory.at_fault[..., 1].any()
    blue = short_sumo.teams[0]
    with pytest.raises(Diverged, match="agent 0's actions"):
        learner.learn(team_batch(jax.tree.map(jnp.asarray, trajectory), blue, 0, slice(None), 1.0))
    figures = rollout_metrics(trajectory, 0, slice(None))
    assert figures["voids"] == figures["own_voids"] == trajectory.void.size
    assert rollout_metrics(trajectory, 1, slice(None))["own_voids"] == 0


def by_hand() -> Trajectory:
    """Four decisions in three worlds, of two teams; the third world is not asked about.

    World 0: a first episode that is cut after its 2nd decision, then one that team 1 loses in its 2nd. World 1: an
    episode of age 7 that is truncated as a draw in the first decision, then one that team 1 makes void in its 2nd.
    """
    flags = {name: np.zeros((4, 3), bool) for name in ("terminated", "truncated", "void", "cut")}
    flags["cut"][1, 0] = flags["truncated"][1, 0] = flags["terminated"][3, 0] = True
    flags["truncated"][0, 1] = flags["void"][2, 1] = True
    flags["terminated"][:, 2] = True
    score, at_fault = np.full((4, 3, 2), 99.0), np.zeros((4, 3, 2), bool)
    score[3, 0], score[0, 1], at_fault[2, 1, 1] = (1.0, 0.0), (0.5, 0.5), True
    reward, shaping = np.zeros((4, 3, 2)), np.full((4, 3, 2), 0.25)
    reward[3, 0], reward[2, 1], shaping[2, 1], reward[:, 2] = (1.0, -1.0), np.nan, np.inf, 50.0
    age = np.array([[1, 7, 1], [2, 1, 1], [1, 2, 1], [2, 1, 1]])
    return Trajectory({}, {}, {}, {}, {}, {}, reward, shaping, score, **flags, at_fault=at_fault, age=age)


@pytest.mark.parametrize("worlds", [slice(0, 2), np.array([1, 0])])
def test_figures_count_whole_episodes_and_decisions_that_were_not_void(worlds):
    common = {"episodes": 2, "counted": 2, "voids": 1, "shaping": 0.25, "length": 4.5}
    assert rollout_metrics(by_hand(), 0, worlds) == {
        **common,
        "own_voids": 0,
        "score": 0.75,
        "reward": pytest.approx(1 / 7),
    }
    assert rollout_metrics(by_hand(), 1, worlds) == {
        **common,
        "own_voids": 1,
        "score": 0.25,
        "reward": pytest.approx(-1 / 7),
    }


def test_void_decisions_are_counted_by_cause():
    causes = np.zeros((4, 3), np.uint8)
    causes[2, 1], causes[0, 2] = Cause.PAIRS | Cause.ROWS, Cause.NUMBERS
    trajectory = by_hand()._replace(causes=causes)
    figures = rollout_metrics(trajectory, 0, slice(0, 2))
    assert {name: n for name, n in figures.items() if name.startswith("void.")} == {"void.pairs": 1, "void.rows": 1}
    assert not any(
        name.startswith("void.") for name in rollout_metrics(trajectory, 0, slice(2, 3))
    )  # none is void there


def test_terms_are_means_over_decisions_and_events_shares_of_episodes():
    """Team 0 scores in the episode that ends, and in the cut one; team 1 touches the ball in both that count."""
    forward, ball = np.full((4, 3, 2), 0.2), np.full((4, 3, 2), 0.05)
    forward[2, 1] = np.nan  # void
    goal, touch = np.zeros((4, 3, 2), bool), np.zeros((4, 3, 2), bool)
    goal[1, 0, 0] = goal[3, 0, 0] = touch[0, 1, 1] = touch[2:, 0, 1] = True
    told = by_hand()._replace(
        terms={"shaping.forward": forward, "shaping.ball": ball}, events={"goal": goal, "touch": touch}
    )
    for team, events in ((0, {"event.goal": 0.5, "event.touch": 0.0}), (1, {"event.goal": 0.0, "event.touch": 1.0})):
        figures = rollout_metrics(told, team, slice(0, 2))
        terms = {"shaping.forward": pytest.approx(0.2), "shaping.ball": pytest.approx(0.05)}
        assert figures == rollout_metrics(by_hand(), team, slice(0, 2)) | terms | events


def test_scores_lengths_and_events_are_of_episodes_that_ended_in_settled_worlds():
    settled = np.ones((4, 3), bool)
    settled[:3, 1] = False  # the draw of world 1, and what it made void
    games = by_hand()._replace(settled=settled, events={"goal": np.ones((4, 3, 2), bool)})
    figures = rollout_metrics(games, 0, slice(0, 2))
    assert [figures[name] for name in ("episodes", "counted", "voids")] == [2, 1, 1]
    assert [figures[name] for name in ("score", "length", "event.goal")] == [1.0, 2.0, 1.0]
    results = episode_results(games, 0, groups=3)
    assert results[:2, 1].tolist() == [[1, 0, 0, 0], [0, 0, 0, 0]]
    assert episode_results(games._replace(settled=None), 0, groups=3)[1, 1].tolist() == [0, 1, 0, 1]


def test_where_no_episode_ended_there_is_no_score():
    figures = rollout_metrics(by_hand()._replace(terminated=np.zeros((4, 3), bool)), 0, slice(0, 1))
    assert figures == {"episodes": 0, "counted": 0, "voids": 0, "own_voids": 0, "reward": 0.25, "shaping": 0.25}
