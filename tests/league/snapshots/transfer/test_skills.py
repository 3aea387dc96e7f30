"""Policies over skills as files and programs, and skills that cannot act in an arena."""

import io
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import onnxruntime
import pytest
import torch

import arenas
from agents.policy.jax_policy import policy_params, stack_policies
from agents.policy.networks import Actor
from agents.policy.skill_arrays import Skill, skill_arrays
from agents.rollout.rollout import make_play
from agents.settings import Architecture, SkillSettings
from arenas.rosters import AgentSizes, roster_text
from league.snapshots.exports.networks import agents_of, memory_units
from league.snapshots.exports.onnx_export import onnx_bytes
from league.snapshots.exports.torchscript_export import torchscript_bytes
from league.snapshots.model_card import _network
from league.snapshots.policy_callable import PolicyCallable, _learnt
from league.snapshots.programs.stored import read, sizes
from league.snapshots.transfer.skills import SkillError, check_skills, team_skills
from storage.errors import StorageError
from storage.records import Snapshot
from tests.arenas.echo import EchoSettings
from tests.league.snapshots.scrambled import scrambled_arrays

SEES, ACTS = 2, 1  # of the arena `echo`, whose episodes have nine decisions here
ROSTER = roster_text([AgentSizes("listener", SEES, ACTS)])
KINDS = {
    "one skill": {"skills": 1, "every": 3},
    "each decision": {"skills": 1, "every": 1},
    "chosen": {"skills": 2, "every": 2},
    "blended": {"skills": 3, "every": 4, "blend": True},
    "held": {"skills": 0, "every": 3},
}
EACH = 8  # worlds of each kind


def network(seed: int, sees: int, acts: int, **kind) -> dict[str, np.ndarray]:
    torch.manual_seed(seed)
    return scrambled_arrays(Actor(sees, acts, Architecture((7, 6), **kind), 0.8))


def over_skills(seed: int, skills: int, every: int, blend: bool = False) -> dict[str, np.ndarray]:
    """A policy of which every number counts; its skills see an observation, a command and a constant."""
    own = [
        Skill(
            network(10 * seed + i, 4, ACTS, **({"squash": 1.5, "layer_norm": True} if i else {})),
            np.array([0, 1, SEES, SEES], np.int32), np.array([skills, i, i, skills], np.int32),
            np.array([0, 0, 0, 0.7], np.float32),
        )
        for i in range(skills)
    ]  # fmt: skip
    choices = skills + (skills if skills > 1 else 0) or ACTS
    return network(seed, SEES, choices) | skill_arrays(own, every, 2.0, blend)


def described(own: dict[str, np.ndarray]) -> dict:
    (agent,) = agents_of({f"0/{name}": array for name, array in own.items()}, ROSTER)
    return agent


@pytest.fixture(scope="module")
def policies():
    return [over_skills(seed, **kind) for seed, kind in enumerate(KINDS.values())]


@pytest.fixture(scope="module")
def episodes(policies):
    """Whole episodes in EACH worlds of each kind: what was seen and done, and the random key of each world."""
    settings = EchoSettings()
    arena = replace(settings, rules=replace(settings.rules, delay=8)).build()
    keys = jax.random.split(jax.random.key(3), EACH * len(KINDS))
    stack = stack_policies([policy_params(own) for own in policies])
    games = jax.device_get(make_play(arena, tuple(range(len(keys))), seen=True)({"pupil/0": stack}, keys))
    start = jax.vmap(lambda key: jax.random.split(key, 2)[1])(keys)
    grouped = [
        np.asarray(x).reshape(9, len(KINDS), EACH, -1)
        for x in (games.seen.observations["pupil/0"], games.actions["pupil/0"])
    ]
    return *grouped, start.reshape(len(KINDS), EACH)


def noise_of(keys: jax.Array, t: int, choices: int, size: int) -> np.ndarray:
    """The league's noise for commands of the worlds with these keys, as a program takes it."""

    def drawn(key: jax.Array) -> jax.Array:
        return jax.random.normal(jax.random.fold_in(jax.random.fold_in(key, t), 0), (choices,))

    return np.pad(np.asarray(jax.vmap(drawn)(keys)), ((0, 0), (0, size - choices)))


def by_onnx(own):
    session = onnxruntime.InferenceSession(onnx_bytes(own, described(own), {"name": "x"}))
    return lambda *given: session.run(None, dict(zip(("observations", "noise", "memory"), given, strict=True)))


def by_torchscript(own):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        module = torch.jit.load(io.BytesIO(torchscript_bytes(own, described(own))))
    return lambda *given: [x.detach().numpy() for x in module(*map(torch.tensor, given))]


@pytest.mark.parametrize("taken", [by_onnx, by_torchscript])
def test_an_exported_policy_over_skills_acts_as_in_the_league_over_whole_episodes(taken, policies, episodes):
    seen, done, keys = episodes
    for kind, own in enumerate(policies):
        act, choices = taken(own), described(own)["over"]["choices"]
        memory = np.zeros((EACH, memory_units(described(own))), np.float32)
        for t in range(len(seen)):
            noise = noise_of(keys[kind], t, choices, max(choices, ACTS))
            actions, memory = act(seen[t, kind].astype(np.float32), noise.astype(np.float32), memory)
            np.testing.assert_allclose(actions, done[t, kind], atol=1e-5)


def test_it_comes_back_as_a_program(policies, tmp_path):
    for number, own in enumerate(policies[:2]):  # whose commands are no more numbers than actions
        path = tmp_path / f"{number}.file"
        as_onnx = number == 0
        path.write_bytes(onnx_bytes(own, described(own), {}) if as_onnx else torchscript_bytes(own, described(own)))
        assert not read("onnx" if as_onnx else "torchscript", [str(path)], ROSTER).singles


def test_a_callable_holds_commands_as_a_match_does(policies):
    """Without exploring: it gives what the ONNX file gives without noise, and begins anew where an episode does."""
    rng, snapshot = np.random.default_rng(1), Snapshot("l", "blue@1", "", ROSTER)
    for own in policies:
        callable_, act = PolicyCallable(snapshot, sizes(ROSTER), [_learnt(policy_params(own))]), by_onnx(own)
        memory = np.zeros((5, memory_units(described(own))), np.float32)
        noise = np.zeros((5, max(described(own)["over"]["choices"], ACTS)), np.float32)
        for t in range(7):
            first = np.arange(5) == 2
            if t == 4:
                callable_.reset(first)
                memory[first] = 0.0
            seen = rng.normal(size=(5, SEES)).astype(np.float32)
            actions, memory = map(np.asarray, act(seen, noise, memory))
            np.testing.assert_allclose(callable_(seen), actions, atol=1e-5)


def test_a_card_tells_of_skills(policies):
    assert "it commands 2 skills with 4 numbers every 2 decisions" in _network(described(policies[2]))
    assert "it commands no skill with 1 numbers" in _network(described(policies[4]))


DAMAGE = {
    "skill.0.source": np.array([0, 1, 3, 2], np.int32),
    "skill.0.target": np.array([0, 1, -1, 1], np.int32),
    "skill.0.fill": np.zeros(3, np.float32),
    "skill.0.mean.bias": np.zeros(2, np.float32),
    "skill.every": np.asarray(0, np.int32),
    "skill.blend": np.asarray(2, np.int32),
    "skill.reach": np.asarray(np.nan, np.float32),
    "skill.1.fill": np.zeros(4, np.float32),
    "mean.bias": np.zeros(0, np.float32),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_arrays_that_are_no_policy_over_skills_are_refused(name, policies):
    with pytest.raises(ValueError, match="agent 0"):
        described(policies[0] | {name: DAMAGE[name]})
    for missing in ("skill.reach", "skill.0.target", "skill.0.std_scale"):
        with pytest.raises(ValueError, match="agent 0"):
            described({k: v for k, v in policies[0].items() if k != missing})


# Which skills act where -----------------------------------------------------------------------------------------------


def arena(name: str):
    return arenas.settings(name).build(engine="c", threads=1)


REFUSED = {
    ("sumo-1v1", "anymal-walk", "slot A", "shift"): "policies: anymal-walk moves robots of kind anymal, and",
    ("sumo-1v1-anymal", "anymal-walk", "slot Z", "shift"): "command: anymal-walk observes no 'slot Z'; it observes",
    ("sumo-1v1-anymal", "anymal-walk", "slot A:4", "shift"): "command: 'slot A:4': slot A of anymal-walk has 3",
    (
        "sumo-1v1-anymal",
        "anymal-score",
        "ball:2",
        "shift",
    ): "mode: sumo-1v1-anymal shows robots of kind anymal no",
    ("sumo-1v1-anymal", "anymal-score", "ball:2", "replace"): 'policies: anymal-score needs "ball\'s velocity"',
    ("sumo-1v1", "leatherback-push", "slot A:2", "shift"): "policies: leatherback-push decides every 0.02 s, and",
    ("soccer-2v2", "anymal-walk", "slot A:2=puck", "shift"): "command: soccer-2v2 shows robots of kind anymal no"
    " 'puck' of 3 numbers; it shows ",
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_skill_that_cannot_act_is_refused_in_one_line(case):
    name, policy, command, mode = case
    with pytest.raises(SkillError) as error:
        check_skills(SkillSettings((policy,), (command,), mode), arena(name))
    assert str(error.value).startswith(REFUSED[case])
    assert "\n" not in str(error.value)


def test_a_skill_sees_the_parts_that_it_knows_wherever_they_are():
    """`anymal-walk` in soccer: there is no slot A, so a command takes its place, and what never moved stays still."""
    pitch = arena("soccer-2v2")
    skills = team_skills(SkillSettings(("anymal-walk",), ("slot A:2",), "replace"), pitch, pitch.teams[0])
    assert skills is not None
    own = skills.arrays[0]
    np.testing.assert_array_equal(own["skill.0.source"], [*range(45), *[66] * 11])
    np.testing.assert_array_equal(own["skill.0.target"][45:], [0, 1, *[2] * 9])
    assert own["skill.0.fill"][47] == pytest.approx(-0.25, abs=0.01)  # the goal's usual height, which is not commanded
    assert team_skills(SkillSettings(("anymal-walk",), ("slot A",)), pitch, pitch.teams[1]) is None  # of rovers


@pytest.mark.parametrize(
    ("policy", "command", "at"),
    [("anymal-walk", "slot A:2=ball", 45), ("anymal-score", "target goal:2=ball", None)],  # the second sees a ball too
)
def test_a_command_can_name_the_part_that_the_skill_sees_in_its_place(policy, command, at):
    pitch = arena("soccer-2v2")
    skills = team_skills(SkillSettings((policy,), (command,)), pitch, pitch.teams[0])
    assert skills is not None
    own, parts = skills.arrays[0], pitch.observation_parts("blue/0")
    first = {part.name: sum(each.size for each in parts[:i]) for i, part in enumerate(parts)}
    at = first["target goal"] if at is None else at  # the scorer learnt with this layout
    np.testing.assert_array_equal(own["skill.0.source"][at : at + 3], np.arange(3) + first["ball"])
    np.testing.assert_array_equal(own["skill.0.target"][at : at + 3], [0, 1, 2])  # the height is not commanded
    np.testing.assert_array_equal(own["skill.0.fill"][at : at + 3], 0.0)
    if policy == "anymal-score":
        seen = own["skill.0.source"][first["ball"] : first["ball"] + 3]
        np.testing.assert_array_equal(seen, np.arange(3) + first["ball"])


def test_several_skills_of_an_agent_have_commands_of_their_own_and_scores():
    pitch = arena("soccer-2v2")
    settings = SkillSettings(
        ("anymal-score", "anymal-ball", "leatherback-score"), ("target goal:2", "ball:2", "target goal:2")
    )
    blue, red = (team_skills(settings, pitch, team) for team in pitch.teams)
    assert blue is not None
    assert red is not None
    assert [agent.action_size for agent in (*blue.team.agents, *red.team.agents)] == [6, 6, 2, 2]
    np.testing.assert_array_equal(blue.arrays[0]["skill.1.target"][45:48], [2, 3, 4])
    assert [agent.action_size for agent in pitch.teams[0].agents] == [12, 12]


def test_an_agent_without_a_skill_acts_by_itself_at_the_clock_of_its_team():
    ring = arena("sumo-within-team")
    skills = team_skills(SkillSettings(("anymal-walk",), ("slot A:2",), every=5), ring, ring.teams[0])
    assert skills is not None
    assert [(a.kind, a.action_size) for a in skills.team.agents] == [("anymal", 2), ("leatherback", 2)]
    assert set(skills.arrays[1]) == {"skill.every", "skill.blend", "skill.reach"}
    assert all(own["skill.every"] == 5 for own in skills.arrays)


@pytest.mark.parametrize(
    ("name", "said"), [("x.safetensors", "is no policy"), ("x.onnx", "is a program, .*safetensors")]
)
def test_a_file_that_is_no_policy_is_refused(name, said, tmp_path: Path):
    (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(StorageError, match=said):
        check_skills(SkillSettings((str(tmp_path / name),), ("slot A",)), arena("sumo-1v1-anymal"))
