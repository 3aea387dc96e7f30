"""Flags, file, preset and store together: what `league run` understands before anything heavy is loaded."""

import os
from dataclasses import replace

import pytest

from league.commands.run.request import read
from league.config import experiment as configuration
from league.config import presets
from league.config.experiment import Config
from league.config.schema import ConfigError
from storage.records import League
from storage.store import Store


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROBOT_LEAGUE_BLOBS", raising=False)
    (tmp_path / "l.toml").write_text('league = "mine"\nseed = 7\n[arena]\nname = "sumo-1v1"\n[training]\nworlds = 64\n')
    return tmp_path


def config(*args: str) -> Config:
    return read(args).config


def refusal(*args: str) -> str:
    with pytest.raises(ConfigError) as caught:
        read(args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "args",
    [
        ("l.toml", "--steps", "5"), ("--steps", "5", "l.toml"), ("--steps=5", "l.toml", "--detach"),
        ("--detach", "l.toml", "--steps", "5"), ("--steps", "5", "--", "l.toml"),
        ("--no-deterministic", "l.toml", "--steps", "5"),
    ],
)  # fmt: skip
def test_a_file_counts_wherever_it_stands(args):
    asked = read(args)
    assert (asked.config.league, asked.config.seed, asked.config.training.worlds) == ("mine", 7, 64)
    assert asked.config.arena.name == "sumo-1v1"
    assert asked.options.steps == asked.config.budget.steps == 5


@pytest.mark.parametrize(
    "text",
    [
        'arena.name = "sumo-1v1"',
        'arena = {name = "sumo-1v1"}',
        '"arena".\'name\' = "sumo-1v1"',
        '[arena] # name = "sumo-2v2"\nname = "sumo-1v1"',
        '# [arena]\n# name = "sumo-2v2"\n[arena]\n"name"="sumo-1v1"',
        'league = "x"\n[arena.rules]\nring = [1.3, 1.8]\n[arena]\nname = "sumo-1v1"',
        "storage.blobs = '''\n[arena]\nname = \"sumo-2v2\"\n'''\n[arena]\nname = 'sumo-1v1'",
    ],
)
def test_a_file_names_its_arena_in_any_way_that_toml_has(text):
    assert configuration.loads(text).arena.blue == ("leatherback",)


def test_a_flag_wins_over_the_file():
    changed = config("l.toml", "--seed", "9", "--training.worlds=32", "--learner.architecture.hidden", "8,4")
    assert (changed.seed, changed.training.worlds) == (9, 32)
    assert changed.learner.architecture.hidden == (8, 4)
    assert changed.league == "mine"
    assert config("l.toml", "--seed", "9", "--seed", "10").seed == 10


def test_a_flag_can_mend_what_would_be_wrong_in_the_file(folder):
    (folder / "l.toml").write_text("[rating]\nworlds = 101\n")
    assert "l.toml:2: rating.worlds = 101" in refusal("l.toml")
    assert config("l.toml", "--rating.worlds", "96").rating.worlds == 96


def test_another_arena_than_the_files_own_is_refused_by_name():
    assert config("l.toml", "--arena.name", "sumo-1v1").arena.name == "sumo-1v1"
    assert refusal("l.toml", "--arena.name", "sumo-2v2").startswith(
        '--arena.name sumo-2v2 contradicts arena.name = "sumo-1v1" in l.toml'
    )


def test_lists_switches_and_none_as_people_write_them():
    changed = config(
        "--rating.milestones", "5s,1m", "--no-rating.record", "--deterministic", "--steps", "9", "--arena.rules.ring",
        "[1.7, 2]", "--training.opponents", '{kind = "uniform", past = 0.5}', "--budget.rating_time=none",
        "--learner.lr=1e-4",
        "--players", '[{team = "blue", hidden = [8]}, {team = "red"}]', "--rating.final-episodes-per-pair", "64",
    )  # fmt: skip
    assert changed.rating.milestones == ("5s", "1m")
    assert (changed.rating.record, changed.deterministic) == (False, True)
    assert changed.arena.rules.ring == (1.7, 2.0)
    assert (changed.training.opponents.kind, changed.training.opponents.past) == ("uniform", 0.5)
    assert (changed.budget.rating_time, changed.learner.lr, changed.rating.final_episodes_per_pair) == (None, 1e-4, 64)
    assert [(p.team, p.hidden) for p in changed.players] == [("blue", (8,)), ("red", None)]


@pytest.mark.parametrize("off", ["--rating.record=false", "--rating.record=no", "--no-rating.record"])
def test_a_switch_is_turned_off_in_every_way(off):
    assert read([off]).config.rating.record is False
    assert read([off, "l.toml"]).config.league == "mine"
    assert read(["--rating.record", "l.toml"]).config.rating.record is True
    assert read(["--rating.record", "no", "l.toml"]).config.rating.record is False


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--detach=maybe",), '--detach = "maybe": expected true or false'),
        (("--deterministic=perhaps",), '--deterministic = "perhaps": expected true or false'),
        (("--no-detach=yes",), "--no-detach takes no value"),
        (("l.toml", "--preset", "nonsense"), "unknown preset 'nonsense' (presets: quickstart, "),
        (("--preset", "duel", "l.toml"), "give a file or --preset, not both"),
        (("--steps", "0"), "--steps = 0: must be at least 1"),
        (("--steps", "-5"), "--steps = -5: must be at least 1"),
        (("--steps",), "--steps needs a value"),
        (("--steps", "--detach"), "--steps needs a value"),
        (("--steps", "5", "--budget.steps", "6"), "--steps 5 contradicts --budget.steps 6"),
        (("--for", "0s"), '--for = "0s": must be longer than nothing'),
        (("--for", "soon"), '--for = "soon": "soon" is not a duration'),
        (("--workers.train", "65"), "--workers.train = 65: must be between 0 and 64"),
        (("--training.worlds", "1e30"), '--training.worlds = "1e30": expected a whole number, or "none"'),
        (("--training.worlds", "99999999999"), "--training.worlds = 99999999999: must be between 2 and 1048576"),
        (("--learner.lr", "nan"), "--learner.lr = nan: must be finite"),
        (("--learner.entropy-coef", "inf"), "--learner.entropy-coef = inf: must be finite"),
        (("--seed", "9" * 400), "must be between 0 and 2147483647"),
        (("--learner.lr", "fast"), '--learner.lr = "fast": expected a number'),
        (("--learner.lr=",), '--learner.lr = "": expected a number'),
        (("--training.wrlds", "9"), "unknown option --training.wrlds: did you mean --training.worlds?"),
        (
            ("--training.snapshots-per-doublng", "9"),
            "unknown option --training.snapshots-per-doublng: did you mean --training.snapshots-per-doubling?",
        ),
        (("--deatch", "l.toml"), "unknown option --deatch: did you mean --detach?"),
        (("--worlds", "9"), "unknown option --worlds: did you mean --training.worlds or --rating.worlds?"),
        (
            ("--budget.time", "30s"),
            "unknown option --budget.time: did you mean --budget.training-time or --budget.rating-time?",
        ),
        (("-d",), "unknown option -d"),
        (("l.toml", "m.toml"), "what is 'm.toml'?"),
        (("--learner.architecture.hidden", "64", "32"), "cannot read 32"),
        (("--learner", "fast"), '--learner = "fast": expected a table'),
        (("--players", "blue"), '--players[0] = "blue": expected a table'),
        (("--training.schedule.kind", "sometimes"), "expected one of"),
        (("--league", "a/b"), "a name is made of letters"),
        (("--deterministic",), "needs a budget in steps"),
        (("--deterministic", "--for", "5m"), "needs a budget in steps"),
        (("--preset", "quickstart", "--deterministic", "--budget.steps", "9"), "time runs differently every time"),
        (
            ("--learner.minibatches", "9999999", "--training.worlds", "4"),
            "--learner.minibatches = 9999999: a batch has",
        ),
        (
            ("--training.devices", "2", "--training.worlds", "9"),
            "--training.worlds = 9: must be a multiple of training.devices, 2: take 8 or 10",
        ),
        (("--training.devices", "0"), "--training.devices = 0: must be between 1 and 64"),
        (
            ("--training.devices", "4", "--training.worlds", "8", "--learner.minibatches", "65"),
            "--learner.minibatches = 65: each device has only 64 samples of a batch",
        ),
        (
            (
                "--training.devices",
                "4",
                "--training.worlds",
                "8",
                "--training.opponents.kind",
                "uniform",
                "--training.opponents.past",
                "0.5",
                "--training.opponents.groups",
                "4",
            ),
            "--training.opponents.groups = 4: each device has only 2 worlds to share",
        ),
    ],
)
def test_what_cannot_be_is_refused_by_name(args, says):
    assert says in refusal(*args)


def test_nothing_of_this_makes_a_file(folder):
    before = sorted(os.listdir(folder))
    refusal("--steps", "0")
    config("--steps", "9", "--preset", "duel")
    assert sorted(os.listdir(folder)) == before


def test_steps_and_time_of_one_run_stand_for_the_budget():
    assert config("--steps", "9").budget.training_time is None
    assert config("--for", "90s").budget.training_time == "90s"
    both = config("--for", "90s", "--steps", "9").budget
    assert (both.training_time, both.steps) == ("90s", 9)
    assert config("--deterministic", "--steps", "9").deterministic


def test_a_plain_run_goes_on_with_the_league_of_the_store_and_flags_change_it(folder):
    assert config() == presets.preset("quickstart")
    kept = replace(presets.preset("duel"), seed=42)
    with Store.open("league-data", create=True) as store:
        store.create_league(League(kept.league, configuration.dumps(kept)))
    asked = read([])
    assert asked.config == kept
    assert asked.continued
    assert read(["--learner.lr", "0.5"]).config.learner.lr == 0.5
    assert not read(["--preset", "quickstart"]).continued
    assert not read(["l.toml"]).continued
    assert "--seed = -1: must be between" in refusal("--seed", "-1")


def test_a_blob_place_beside_the_store_is_one_setting():
    assert config("--blobs", "there").storage.blobs == config("--storage.blobs", "there").storage.blobs == "there"


def test_what_the_heavy_half_refuses_is_told_where_it_was_given():
    error = ConfigError(("training", "schedule", "learner"), "training.schedule.learner = 2: the arena's teams are ...")
    by_flag = read(["l.toml", "--training.schedule.learner", "2"]).with_location(error)
    assert str(by_flag).startswith("--training.schedule.learner = 2")
    (asked,) = [read(["l.toml"])]
    assert str(asked.with_location(ConfigError(("arena", "name"), "no"))) == "l.toml:4: no"
