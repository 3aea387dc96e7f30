"""Terms of functions in files: added to rewards and observations, or in the place of those of their names."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.arena_settings import Table
from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS
from arenas.errors import ArenaError
from league.commands import cli
from league.config import experiment
from league.config.schema import ConfigError
from league.runtime.validation import validate

GAME = arenas.settings("rock-paper-scissors")
FUNCTIONS = """
import jax.numpy as jnp

def paper(arena, before, physics, game):
    return (game.chosen == 1) * 1.0

def two(arena, before, physics, game):
    return jnp.array([2.0, 2.0])

def chosen(arena, agent, physics, game, actions):
    return jnp.stack([game.chosen[0], game.total])

def zero(arena, agent, physics, game, actions):
    return 0.0

def scalar(arena, before, physics, game):
    return 1.0

def broken(arena, before, physics, game):
    return game.missing

def table(arena, agent, physics, game, actions):
    return jnp.zeros((2, 2))

def branches(arena, before, physics, game):
    if game.total > 1:
        return jnp.ones(2)
    return jnp.zeros(2)

def too_few(arena, physics, game):
    return jnp.zeros(2)

def lengths(arena, agent, physics, game, actions):
    return jnp.full(len(agent), 0.37)

def pair(arena, agent, physics, game, actions):
    return jnp.zeros(2)

def infinite(arena, before, physics, game):
    return jnp.full(2, jnp.inf)
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "terms.py"
    path.write_text(FUNCTIONS)
    return path


def built(rewards=(), observations=(), settings=GAME, worlds=1):
    reward = replace(settings.reward, terms=Table(dict(rewards)))
    return replace(settings, reward=reward, observation_terms=Table(dict(observations))).build(
        engine="c", worlds=worlds
    )


def after(arena, blue, red):
    """The state after one round in which the teams make these choices."""
    state = arena.reset(jax.random.key(0))
    return arena.step(state, {"blue/0": jax.nn.one_hot(blue, 3), "red/0": jax.nn.one_hot(red, 3)})


def test_a_term_is_added_with_its_weight_or_takes_the_place_of_its_namesake(file):
    plain = after(built(), 1, 0).verdict
    added = after(built({"paper": {"function": f"{file}:paper", "weight": 0.5}}), 1, 0).verdict
    np.testing.assert_array_equal(added.reward, plain.reward + jnp.array([0.5, 0.0]))
    replaced = after(built({"payoff": f"{file}:two"}), 1, 0).verdict
    assert list(replaced.rewards) == ["payoff"]
    np.testing.assert_array_equal(replaced.reward, [2.0, 2.0])
    dense = after(built({"paper": {"function": f"{file}:paper", "shaping": True}}), 1, 0).verdict
    np.testing.assert_array_equal(dense.reward, plain.reward)
    np.testing.assert_array_equal(dense.shaping, [1.0, 0.0])
    for verdict in (added, replaced, dense):
        np.testing.assert_array_equal(verdict.score, plain.score)


def test_observations_grow_by_a_term_or_have_a_part_replaced(file):
    arena = built(observations={"last": f"{file}:chosen", "one": f"{file}:zero"})
    assert [agent.observation_size for agent in arena.agents] == [3, 3]
    assert [part.name for part in arena.observation_parts("blue/0")] == ["one", "last"]
    np.testing.assert_array_equal(after(arena, 2, 1).observations["red/0"], [0.0, 2.0, 1.0])
    assert arena.teams[0].roster == "chooser:3:3"


@pytest.mark.parametrize("name", ["sumo-1v1", "pursuit"])
def test_scripts_see_nothing_of_what_follows_the_observation(file, name):
    plain = built(settings=arenas.settings(name))
    added = built(observations={"more": f"{file}:lengths"}, settings=arenas.settings(name))
    state, key = jax.jit(plain.reset)(jax.random.key(1)), jax.random.key(0)
    before, seen = (arena.observe(state.physics, state.game, state.actions) for arena in (plain, added))
    for agent in plain.agents:
        assert seen[agent.name].size == agent.observation_size + len(agent.name)  # another number for each agent
        for script, kinds in plain.scripts().items():
            if agent.kind in kinds:
                action = added.scripts()[script][agent.kind](seen[agent.name], key)
                np.testing.assert_array_equal(action, kinds[agent.kind](before[agent.name], key))


def test_a_term_in_the_place_of_a_part_about_the_opponent_is_about_it_too(file):
    settings = arenas.settings("pursuit")
    parts = built(observations={"prey": f"{file}:pair"}, settings=settings).observation_parts("predators/0")
    assert [part.name for part in parts if part.opponent] == ["prey", "prey, moving"]
    assert next(part for part in parts if part.name == "prey").meaning.endswith(":pair")


def test_observations_are_part_of_the_rules_and_rewards_are_not(file):
    plain, sees = built().config_hash, {"last": f"{file}:chosen"}
    seen = built(observations=sees).config_hash
    assert built({"paper": f"{file}:paper"}).config_hash == plain
    assert seen != plain
    file.write_text(FUNCTIONS + "\n")  # the file's bytes count, whatever Python has loaded of it
    assert built(observations=sees).config_hash not in (plain, seen)


def test_the_check_examines_an_arena_with_terms(file):
    good = built({"paper": f"{file}:paper"}, {"last": f"{file}:chosen"}, worlds=WORLDS)
    assert [each for each in check_arena(good) if not each.ok] == []


def test_the_page_shows_the_example_and_a_robot_on_its_side_earns_less():
    docs = Path(__file__).parents[3] / "docs"
    example = docs / "examples" / "terms.py"
    assert f"```python\n{example.read_text('utf-8')}```" in (docs / "rewards.md").read_text("utf-8")
    arena, upright = arenas.load("sumo-1v1", engine="c", threads=1), arenas.python_file(example).upright
    standing, _, _ = arena.place(jax.random.key(0))
    first = arena.scene.agents["blue/0"].qpos + 3
    lying = standing.at[first : first + 4].set(jnp.array([0.5**0.5, 0.5**0.5, 0.0, 0.0]))  # rolled by 90 degrees
    earned = [upright(arena, None, SimpleNamespace(qpos=qpos), None) for qpos in (standing, lying)]
    np.testing.assert_allclose(earned, [[0.02, 0.02], [0.0, 0.02]], atol=1e-6)


@pytest.mark.parametrize(("rewards", "observations", "line"), [
    ({"x": "gone.py:f"}, {}, r"reward\.terms: x = gone\.py:f: there is no such file"),
    ({"x": "{}:none"}, {}, r"the file has no function none \(functions: paper, two, .*infinite\)"),
    ({"x": "{}:scalar"}, {}, r"it returns shape \(\) and not one number per team, \(2,\) \(terms\.py:16\)"),
    ({"x": "{}:broken"}, {}, r"AttributeError: 'Rounds' object has no attribute 'missing' \(terms\.py:20\)"),
    ({"x": "{}:branches"}, {}, r"TracerBoolConversionError: .*; use jnp\.where .* \(terms\.py:26\)"),
    ({"x": "{}:too_few"}, {}, r"takes \(arena, physics, game\), and must take \(arena, before, .*\) \(terms\.py:30\)"),
    ({}, {"x": "{}:two"}, r"takes \(arena, before, .*\), and must take \(arena, agent, .*, actions\) \(terms\.py:7\)"),
    ({}, {"x": "{}:table"}, r"observation_terms: x = .*: it returns shape \(2, 2\) and not \(n,\) \(terms\.py:22\)"),
    ({}, {"one": "{}:chosen"}, r"it returns 2 numbers, and the part of that name has 1 \(terms\.py:10\)"),
])  # fmt: skip
def test_a_function_that_cannot_be_a_term_is_one_line_when_the_arena_is_built(file, rewards, observations, line):
    named = [{name: where.format(file) for name, where in each.items()} for each in (rewards, observations)]
    with pytest.raises(ArenaError, match=line) as error:
        built(*named)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "settings", {type(each): each for each in arenas.known().values()}.values(), ids=lambda each: each.name
)
def test_all_arenas_take_terms(settings):
    with pytest.raises(ArenaError, match=r"reward\.terms: x = gone\.py:f: there is no such file"):
        built({"x": "gone.py:f"}, settings=settings)


@pytest.mark.parametrize(("text", "line"), [
    ('{x = "f"}', r"x: must name a function in a file, such as my/terms\.py:x"),
    ('{x = {function = "a.py:f", wieght = 2}}', r"x: unknown key wieght \(keys: function, weight, shaping\)"),
    ('{x = {function = "a.py:f", weight = "2"}}', "x: its weight must be a number"),
    ("3", "expected a table"),
])  # fmt: skip
def test_settings_refuse_what_describes_no_term(text, line):
    with pytest.raises(ConfigError, match=line):
        experiment.change(experiment.default(GAME.name), {("arena", "reward", "terms"): text})


def test_terms_are_written_and_read_as_json_or_toml_and_survive_a_file():
    base = experiment.default(GAME.name)
    key = ("arena", "reward", "terms")
    for text in ('{"stay-up": {"function": "a.py:f", "weight": 2}}', '{stay-up = {function = "a.py:f", weight = 2}}'):
        config = experiment.change(base, {key: text})
        assert config.arena.reward.terms == {"stay-up": {"function": "a.py:f", "weight": 2}}
        assert experiment.loads(experiment.dumps(config)) == config
    flags = {(*key, "other"): "b.py:g", (*key, "stay_up", "weight"): "3"}  # a flag has _ for -
    for more in (experiment.change(config, flags), experiment.loads(experiment.dumps(config), given=flags)):
        assert more.arena.reward.terms == {"stay-up": {"function": "a.py:f", "weight": 3}, "other": "b.py:g"}
        less = experiment.loads(experiment.dumps(more), given={(*key, "stay_up"): "none"})
        assert less.arena.reward.terms == {"other": "b.py:g"}


def test_league_check_takes_terms(file, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["check", GAME.name, "--engine", "c", "--arena.reward.terms", f'{{"x": "{file}:infinite"}}'])
    assert ended.value.code == 1
    assert "FAILED  rewards, shapings and scores are finite: x is not finite" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["terms.py", "added_terms.py", "mine.py"])  # two are also names of the league's files
def test_check_and_run_give_one_line_with_the_place_in_a_relative_file(name, file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my").mkdir()
    (tmp_path / "my" / name).write_text(FUNCTIONS.replace("def broken", "# another file\ndef broken"))
    where = f"my/{name}:broken"
    config = experiment.change(experiment.default(GAME.name), {("arena", "reward", "terms"): f'{{"x": "{where}"}}'})
    with pytest.raises(ConfigError) as refused:
        validate(config)
    with pytest.raises(SystemExit) as ended:
        cli.main(["check", GAME.name, "--engine", "c", "--arena.reward.terms", f'{{"x": "{where}"}}'])
    assert ended.value.code == 1
    line = f"x = {where}: AttributeError: 'Rounds' object has no attribute 'missing' ({name}:21)"
    assert refused.value.message == f"arena.reward.terms: {line}"
    assert capsys.readouterr().out.strip().endswith(f": {refused.value.message}")


def test_a_file_with_a_fault_of_syntax_is_named_with_its_line(file):
    file.write_text("import jax\n\ndef broken(:\n")
    with pytest.raises(ArenaError, match=r"x = .*: SyntaxError: .* \(terms\.py:3\)"):
        built({"x": f"{file}:broken"})
