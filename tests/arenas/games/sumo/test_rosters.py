"""Any teams: n against m of any kinds, and what cannot be told in one line."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS
from arenas.games.sumo import SumoReward, SumoRules, SumoSettings
from arenas.games.sumo.match import GameState
from arenas.games.sumo.settings import OUTCOME, PAPER
from league.config import experiment
from league.config.schema import ConfigError
from tests.arenas.hooks import judging, observing

SHORT = replace(PAPER, episode=1.0)
UNEVEN = SumoSettings(
    "uneven", ("anymal",), ("leatherback", "anymal", "minitank"), "slots", rules=SHORT, reward=OUTCOME
)
RING = GameState(jnp.asarray(3.0))


@pytest.fixture(scope="module")
def uneven():
    """One ANYmal against three others, who see richly and are paid for pushing."""
    rules = SumoRules(ring=(4.0, 5.0))
    return replace(UNEVEN, observation="rich", rules=rules, reward=SumoReward()).build(engine="c")


@pytest.mark.slow
@pytest.mark.parametrize("observation", ["rich", "slots"])
def test_one_against_three_of_other_kinds_keeps_the_contract(observation):
    settings = replace(UNEVEN, observation=observation)
    arena = settings.build(engine="c", worlds=WORLDS)
    assert [result for result in check_arena(arena, settings) if not result.ok] == []
    assert [len(team.agents) for team in arena.teams] == [1, 3]


def test_any_robot_of_the_larger_team_loses_it_the_match(uneven, stand):
    poses = [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0), (-1.0, -3.0, 0.0)]
    physics = stand(uneven, poses, 1.0)
    np.testing.assert_array_equal(judging(uneven)(physics, physics, RING)[1].score, [1.0, 0.0])


def test_shaping_is_the_mean_over_each_team_whatever_its_size(uneven, stand):
    before = stand(uneven, [(0.5, 0.0, 0.0), (-1.0, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, -2.5, 0.0)])
    after = stand(uneven, [(0.5, 0.0, 0.0), (-1.015, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, -2.515, 0.0)])
    shaping = judging(uneven)(before, after, RING)[1].shaping
    # Red moved 0.03 m outwards in all, 0.01 m on average. Blue lost 0.015 m to its nearest enemy; red 0.015 m and,
    # along the diagonal from (0.5, 0) to (0, -2.5), 0.0147 m.
    diagonal = np.hypot(0.5, 2.515) - np.hypot(0.5, 2.5)
    np.testing.assert_allclose(shaping, [0.01 - 0.2 * 0.015, -0.01 - 0.2 * (0.015 + diagonal) / 3], atol=2e-6)


def test_everybody_sees_everybody_and_enemies_last(uneven, stand):
    physics = stand(uneven, [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.5, 0.0, 0.0)])
    actions = {a.name: jnp.zeros(a.action_size) for a in uneven.agents}
    seen = {name: np.asarray(x) for name, x in observing(uneven)(physics, RING, actions).items()}
    assert {name: len(x) for name, x in seen.items()} == {"blue/0": 81, "red/0": 38, "red/1": 81, "red/2": 42}
    np.testing.assert_allclose(seen["blue/0"][[54, 63, 72]], [1.0, 2.0, 2.5], atol=1e-6)
    np.testing.assert_allclose(seen["red/0"][[11, 20, 29]], [1.0, 1.5, -1.0], atol=1e-6)
    np.testing.assert_allclose(seen["red/2"][[15, 24, 33]], [-1.5, -0.5, -2.5], atol=1e-6)


@pytest.mark.parametrize(
    ("blue", "red"),
    [(("leatherback",), ("leatherback",)), (("anymal", "leatherback"), ("minitank", "anymal"))],
)
def test_teams_of_any_kinds_begin_and_see_what_they_should(blue, red):
    arena = SumoSettings("any", blue, red, rules=SumoRules(ring=(3.5, 4.0))).build(engine="c")
    state = jax.jit(arena.reset)(jax.random.key(0))
    assert [a.kind for a in arena.agents] == [*blue, *red]
    for agent in arena.agents:
        assert state.observations[agent.name].shape == (agent.observation_size,)
        at = arena.scene.agents[agent.name].qpos
        np.testing.assert_allclose(state.physics.qpos[at + 2], arena.robots[agent.name].rest_height, atol=1e-6)
    assert set(arena.playable_scripts(arena.teams[0])) == {"idle", "random", "pusher", "centre-holder"}


def test_randomised_bodies_differ_and_count_as_rules():
    settings = replace(UNEVEN, randomisation=replace(UNEVEN.randomisation, friction=(0.5, 0.9)))
    arena = settings.build(engine="c")
    keys = jax.random.split(jax.random.key(0), 3)
    friction = jax.jit(jax.vmap(arena.reset))(keys).physics.model["geom_friction"]
    assert not np.allclose(friction[0], friction[1])
    assert arena.config_hash != UNEVEN.build(engine="c").config_hash
    assert UNEVEN.build(engine="c").randomise(keys[0]) == {}


BAD = [
    ('blue = ["anymal", "leatherbak"]', "unknown robot 'leatherbak': did you mean leatherback? (robots: leatherback, "),
    ("red = []", "red = []: a team needs at least one robot"),
    (
        "rules.ring = [2.0, 3.0]",
        "rules.ring = [2.0, 3.0]: robots could start inside each other in a ring of 2.0 m; it must begin at 2.6",
    ),
    (
        "rules.spacing = 0.6",
        "rules.spacing = 0.6: robots of 1.18 m could start inside each other 0.6 m apart; 1.18 or more",
    ),
    ('rules.spawn = "anywhere"', 'one of "diameter", "lattice"'),
    ("buffer = -1", "arena.buffer = -1: must be between 0 and 1000"),
    ('observation = "blind"', 'one of "rich", "slots"'),
    ("team_size = 2", "unknown key arena.team_size"),
]


@pytest.mark.parametrize(("line", "says"), BAD)
def test_bad_input_is_one_line_with_field_value_and_what_is_possible(line, says):
    with pytest.raises(ConfigError) as caught:
        experiment.loads(f'[arena]\nname = "sumo-by-team"\n{line}\n')
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
