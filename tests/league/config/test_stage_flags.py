"""Flags of one stage: `--stages.match.learner.lr 1e-4`, over a preset's, a file's and a stored league's."""

import pytest

from league.commands.run import request
from league.config import experiment as configuration
from league.config.schema import ConfigError

FILE = """
league = "cup"
arena.name = "sumo-1v1"
budget.steps = 4000

[[stages]]
name = "first-steps"
arena.name = "kick-and-defend"
learner.lr = 1e-4
budget.steps = 1000

[[stages]]
name = "match"
"""


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Read a command line in an empty folder, or one with FILE as cup.toml."""
    (tmp_path / "cup.toml").write_text(FILE)
    monkeypatch.chdir(tmp_path)
    return lambda *args: request.read(args).config


def stages(config):
    return {own.name: configuration.stage(config, i) for i, own in enumerate(config.stages)}


def test_a_flag_of_a_stage_of_a_preset_is_of_that_stage_alone(read):
    plain = stages(read("--preset", "sumo-by-team"))
    flags = ("--stages.match.learner.minibatches", "2", "--no-stages.match.learner.share-actors")
    config = read("--preset", "sumo-by-team", *flags, "--stages.push-anymal.budget.steps=1000")
    found = stages(config)
    assert plain["match"].learner.share_actors
    assert not found["match"].learner.share_actors
    assert found["match"].learner.minibatches == 2 != plain["match"].learner.minibatches
    assert found["match"].learner.lr == plain["match"].learner.lr
    assert found["push-anymal"].budget.steps == 1000
    assert {name: found[name] for name in ("walk", "push-leatherback")} == {
        name: plain[name] for name in ("walk", "push-leatherback")
    }
    assert configuration.loads(configuration.dumps(config)) == config


def test_a_flag_is_over_the_stage_of_a_file_and_may_be_of_its_arena(read):
    flags = ("--stages.first-steps.arena.rules.falls-lose", "--stages.first-steps.learner.lr", "2e-4")
    found = stages(read(*flags, "cup.toml", "--learner.lr", "3e-4"))  # the switch takes no word that follows
    assert found["first-steps"].arena.rules.falls_lose
    assert (found["first-steps"].learner.lr, found["match"].learner.lr) == (2e-4, 3e-4)


def test_a_flag_may_give_a_stage_another_arena(read):
    found = stages(read("cup.toml", "--stages.match.arena.name", "sumo-2v2", "--stages.match.arena.rules.episode", "7"))
    assert (found["match"].arena.name, found["match"].arena.rules.episode) == ("sumo-2v2", 7.0)
    assert found["first-steps"].arena.name == "kick-and-defend"


LX = "stage match: unknown option --stages.match.learner.lx: did you mean --stages.match.learner.lr? (--help lists all)"
REFUSED = [
    (("--stages.mach.learner.lr", "1"), "--stages.mach: no stage has that name; there are first-steps, match"),
    (("--stages.match.seed", "3"), "--stages.match.seed: is the same in all stages; give --seed"),
    (("--stages.match", "3"), "--stages.match: name a stage and a key of it: --stages.match.learner.lr 1e-4"),
    (("--stages.match.learner.lx", "3"), LX),
    (("--stages.match.stages", "3"), "--stages.match.stages: a stage has no stages of its own"),
    (("--stages.match.learner.lr", "x"), 'stage match: learner.lr = "x": expected a number'),
    (("--stages.first-steps.learner.lr", "7"), "stage first-steps: learner.lr = 7.0: must be between 0.0 and 1.0"),
    (("--stages.match.arena.name", "chess"), "stage match: unknown arena 'chess'"),
]


@pytest.mark.parametrize(("flags", "line"), REFUSED)
def test_bad_flags_of_stages_are_refused_in_one_line(read, flags, line):
    with pytest.raises(ConfigError) as refused:
        read("cup.toml", *flags)
    assert str(refused.value).startswith(line)
    assert "\n" not in str(refused.value)


def test_a_flag_of_happo_is_refused_for_a_stage_that_learns_otherwise(read, tmp_path):
    own = f"{tmp_path / 'mine.py'}:Mine"
    (tmp_path / "mine.py").write_text("class Mine: ...")
    with pytest.raises(ConfigError, match=r"^stage match: learner.lr = 1e-4: is a setting of happo, and learner.class"):
        read("cup.toml", "--learner.class", own, "--stages.match.learner.lr", "1e-4")


def test_an_invalid_stage_of_a_file_is_told_with_its_line(read, tmp_path):
    (tmp_path / "cup.toml").write_text(FILE.replace('name = "match"', 'name = "match"\nseed = 3'))
    with pytest.raises(ConfigError, match=r"^cup.toml:14: stages\[1\].seed: is the same in all stages"):
        read("cup.toml", "--stages.match.learner.lr", "1e-4")


def test_a_league_without_stages_has_no_flags_of_stages(read):
    with pytest.raises(ConfigError, match=r"^--stages.match: no stage has that name; this league has no stages$"):
        read("--preset", "quickstart", "--stages.match.learner.lr", "1e-4")
