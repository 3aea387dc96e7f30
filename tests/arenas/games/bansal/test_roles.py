"""Drawn and fixed roles, what the two see, bodies and their drives, and settings that cannot be."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS
from arenas.games.bansal.settings import ARENAS, YouShallNotPassRules, original_timing
from arenas.games.terms import weights_of
from league.commands.run.request import read
from league.config import experiment
from league.config.schema import ConfigError
from tests.arenas.games.bansal.contests import built, put, state
from tests.arenas.hooks import observing

PASS = arenas.settings("you-shall-not-pass")
FIXED = replace(PASS, rules=replace(PASS.rules, roles="fixed", episode=1.0))


def test_drawn_roles_make_teams_of_one_roster_and_fixed_ones_a_ladder_each():
    drawn, fixed = built("you-shall-not-pass"), FIXED.build(engine="c", threads=1)
    assert len({team.roster for team in drawn.teams}) == 1
    assert [team.name for team in drawn.teams] == ["blue", "red"]
    assert [team.roster.rpartition("@")[2] for team in fixed.teams] == ["runner", "blocker"]
    assert {a.observation_size for a in (*drawn.agents, *fixed.agents)} == {drawn.agents[0].observation_size}
    assert drawn.config_hash != fixed.config_hash
    key = jax.random.split(jax.random.key(0), 64)
    assert 0.3 < np.asarray(jax.jit(jax.vmap(drawn.place))(key)[2].second_first).mean() < 0.7
    assert not np.asarray(jax.jit(jax.vmap(fixed.place))(key)[2].second_first).any()


@pytest.mark.slow
def test_fixed_roles_keep_the_contract():
    arena = FIXED.build(engine="c", worlds=WORLDS)
    assert [result for result in check_arena(arena, FIXED) if not result.ok] == []


@pytest.mark.parametrize("name", [settings.name for settings in ARENAS])
def test_a_body_sees_the_same_from_either_place_and_its_role(name):
    """The situation turned by half a turn, with the places exchanged, looks the same but for the role."""
    arena = built(name)
    here = put(arena, ((-1.0, 0.3, 0.6, 0.2), (1.5, -0.4, 0.7, 2.0)), ball=(0.5, 0.2, 1.0) if "kick" in name else None)
    turned = put(
        arena,
        ((1.0, -0.3, 0.6, 0.2 + np.pi), (-1.5, 0.4, 0.7, 2.0 + np.pi)),
        ball=(-0.5, -0.2, -1.0) if "kick" in name else None,
    )
    own = arena.draw(jax.random.key(0))[1]
    actions = {agent: jnp.zeros(arena.robot.action_size) for agent in arena.names}
    one = observing(arena)(here, state(arena, own), actions)["blue/0"]
    other = observing(arena)(turned, state(arena, own, second_first=True), actions)["blue/0"]
    differ = np.flatnonzero(~np.isclose(one, other, atol=1e-4))
    names = np.repeat(
        [p.name for p in arena.observation_parts("blue/0")], [p.size for p in arena.observation_parts("")]
    )
    assert set(names[differ]) == ({"role"} if arena.observation_builder.sides[0] != "blue" else set())


def test_the_opponents_numbers_and_no_others_change_with_the_opponent():
    arena = built("sumo-ants")
    own, actions = arena.draw(jax.random.key(0))[1], {a: jnp.zeros(8) for a in arena.names}
    seen = [
        np.asarray(observing(arena)(put(arena, ((-1.0, 0.0, 0.5), there)), state(arena, own), actions)["blue/0"])
        for there in ((1.0, 0.0, 0.5), (1.5, 0.7, 0.9, 1.0))
    ]
    marked = np.concatenate([np.full(part.size, part.opponent) for part in arena.observation_parts("blue/0")])
    changed = seen[0] != seen[1]
    assert changed.any()
    assert not (changed & ~marked).any()


def test_a_humanoid_of_torques_is_another_kind_with_the_originals_limits():
    arena = replace(PASS, drive="torque").build(engine="c", threads=1)
    assert arena.robot.kind == "humanoid-torque"
    command = np.asarray(arena.robot.command(jnp.ones(17)))
    np.testing.assert_allclose(sorted(set(command.tolist())), [10, 40, 80, 120])  # 0.4 × gears of 25 to 300
    model, names = arena.scene.model, arena.robot.joints
    assert not model.actuator_biasprm.any()
    assert len(names) == model.nu // 2
    assert {"stand", "idle", "random"} <= set(arena.scripts())
    assert "stand" not in built("you-shall-not-pass").scripts()


@pytest.mark.parametrize(
    ("name", "decisions", "seconds"),
    [("run-to-goal", 500, 0.05), ("sumo-ants", 500, 0.015), ("kick-and-defend", 500, 0.015)],
)
def test_the_originals_timing(name, decisions, seconds):
    timing = original_timing(arenas.settings(name)).timing
    assert timing.decisions == decisions
    assert timing.decision_interval == pytest.approx(seconds)


def test_any_robot_with_legs_can_play():
    settings = replace(arenas.settings("run-to-goal"), robot="anymal", rules=YouShallNotPassRules(episode=0.5))
    assert settings.outline().teams["blue"][0].action_size == 12
    arena = settings.build(engine="c", threads=1)
    assert arena.observation_size("blue/0") == settings.outline().teams["blue"][0].observation_size


BAD = [
    ('robot = "ants"', "robot = \"ants\": unknown robot 'ants': did you mean ant?"),
    ('robot = "anymal"\ndrive = "torque"', "drive"),
    ('rules.roles = "random"', "rules.roles"),
]


@pytest.mark.parametrize(("lines", "message"), BAD)
def test_bad_settings_are_refused_in_one_line(lines, message):
    with pytest.raises(ConfigError) as refused:
        experiment.loads(f'[arena]\nname = "you-shall-not-pass"\n{lines}\n')
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["you-shall-not-pass", "kick-and-defend"])
def test_games_of_roles_pay_no_draw_and_read_files_that_name_it(name):
    former = experiment.loads(f'[arena]\nname = "{name}"\nreward.draw = -2.0\n')
    assert former == experiment.default(name)
    assert "draw" not in weights_of(former.arena.reward)
    with pytest.raises(ConfigError, match=r"^--arena\.reward\.draw: it was removed, because this game has no term"):
        read(["--arena.name", name, "--arena.reward.draw", "-2"])


def test_a_ring_without_room_is_refused():
    with pytest.raises(ConfigError, match="apart"):
        experiment.loads('[arena]\nname = "sumo-ants"\nrules.ring = [1.0, 2.0]\n')


def test_an_ants_gait_walks_forward_and_standing_stays(worlds):
    tried = worlds(built("run-to-goal", episode=5.0))
    states = tried.play("walk", "stand", worlds=8)
    walker, stander = (states.observations[name][:, :, 0] for name in ("blue/0", "red/0"))  # (T, worlds) m forward
    assert np.median(walker.max(axis=0)) > -0.3  # from -1; the other stands in the way
    assert np.median(np.abs(stander[30] + 1.0)) < 0.4  # until it is pushed
