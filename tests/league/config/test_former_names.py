"""Former names of settings: accepted in files, flags and stored configurations, and written nowhere."""

import numpy as np
import pytest

from agents.settings import HappoConfig
from league.commands.design.init import init
from league.commands.run.request import read
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.presets import PRESETS
from league.config.schema import ConfigError, settings
from league.queries.league_settings import LeagueSettings
from league.scheduling import population
from matchmaking.pbt import FORMER, TUNABLE, Pbt, explore
from scripts.reference_pages import configuration as settings_page

OLD = """
league = "old"
[training]
rollout = 24
turn = 3
[rating]
quota = 64
[budget]
train = "1m"
rate = "10s"
[learner]
lam = 0.9
kl_stop = 0.05
[learner.trust_region]
tries = 7
[workers]
tries = 2
[[stages]]
name = "walk"
arena.name = "anymal-walk"
budget.train = "30s"
[[stages]]
name = "match"
training.rollout = 8
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.toml").write_text(OLD)
    return tmp_path


def check(config: Config) -> None:
    assert (config.training.rollout_length, config.training.iterations_per_turn) == (24, 3)
    assert config.rating.episodes_per_pair == 64
    assert (config.budget.training_time, config.budget.rating_time) == ("1m", "10s")
    assert (config.learner.gae_lambda, config.learner.target_kl) == (0.9, 0.05)
    assert (config.learner.trust_region.line_search_steps, config.workers.max_attempts) == (7, 2)
    assert configuration.stage(config, 0).budget.training_time == "30s"
    assert configuration.stage(config, 1).training.rollout_length == 8


def test_a_file_with_former_names_is_read_and_one_line_names_the_present_ones(capsys):
    check(read(["old.toml"]).config)
    line = capsys.readouterr().err
    assert line.startswith("league: deprecated, accepted until the next release: ")
    assert line.count("\n") == 1
    assert "training.rollout is now training.rollout_length" in line
    assert "learner.trust_region.tries is now learner.trust_region.line_search_steps" in line


@pytest.mark.parametrize("preset", PRESETS)
def test_a_file_may_lay_former_names_over_any_preset(folder, preset):
    (folder / "over.toml").write_text(f'preset = "{preset}"\nbudget.rate = "7s"\nlearner.entropy = 0.0625\n')
    config = read(["over.toml"]).config
    assert (config.budget.rating_time, config.learner.entropy_coef) == ("7s", 0.0625)


def test_what_is_stored_is_read_without_a_word(capsys):
    check(configuration.loads(OLD))
    assert capsys.readouterr() == ("", "")


def test_a_flag_may_have_its_former_name(capsys):
    config = read(["--training.rollout", "12", "--learner.lam=0.8", "--budget.rate", "none"]).config
    assert (config.training.rollout_length, config.learner.gae_lambda, config.budget.rating_time) == (12, 0.8, None)
    assert "learner.lam is now learner.gae_lambda" in capsys.readouterr().err


def test_a_flag_of_the_present_name_counts_over_a_file_of_the_former_one():
    assert read(["old.toml", "--training.rollout_length", "16"]).config.training.rollout_length == 16


@pytest.mark.parametrize(
    "args", [["--training.rollout", "12", "--training.rollout_length", "12"], ["both.toml"]], ids=["flags", "file"]
)
def test_both_names_at_once_are_refused(folder, args):
    (folder / "both.toml").write_text("[training]\nrollout = 24\nrollout_length = 24\n")
    with pytest.raises(ConfigError, match=r"training\.rollout is now .*training\.rollout.length: give only"):
        read(args)


def test_an_error_names_the_key_and_line_that_the_file_has(folder):
    (folder / "wrong.toml").write_text("[training]\nworlds = 8\nrollout = 0\n")
    with pytest.raises(ConfigError) as caught:
        read(["wrong.toml"])
    assert str(caught.value).startswith("wrong.toml:3: training.rollout_length = 0")


def test_both_names_in_a_stage_are_refused_with_its_line(folder):
    (folder / "both.toml").write_text('[[stages]]\nname = "a"\ntraining.rollout = 3\ntraining.rollout_length = 3\n')
    with pytest.raises(ConfigError) as caught:
        read(["both.toml"])
    assert str(caught.value).startswith("both.toml:3: stages[0].training.rollout is now stages[0].training.rollout_l")


def test_hyperparameters_that_move_may_have_former_names_in_settings_and_checkpoints():
    assert Pbt(9, hyperparameters=("lam", "entropy", "lr")).hyperparameters == ("gae_lambda", "entropy_coef", "lr")
    state = {"hyperparameter.lam": np.array(0.9), "hyperparameter.entropy_coef": np.array(0.25), "adam": np.zeros(2)}
    for names in (("lam", "entropy"), ("gae_lambda", "entropy_coef")):
        assert population.read(state, names) == {"gae_lambda": 0.9, "entropy_coef": 0.25}


def test_a_former_name_among_hyperparameters_is_named_once_by_its_place(folder, capsys):
    told = 'league: deprecated, accepted until the next release: "lam" in training.pbt.hyperparameters is now "gae_l'
    (folder / "pbt.toml").write_text('[training.pbt]\nready = 9\nhyperparameters = ["lr", "lam"]\n')
    for args in (["pbt.toml"], ["--training.pbt.ready", "9", "--training.pbt.hyperparameters", "lr,lam"]):
        assert read(args).config.training.pbt.hyperparameters == ("lr", "gae_lambda")
        assert capsys.readouterr().err == f'{told}ambda"\n'
    assert read(["pbt.toml", "--training.pbt.hyperparameters", "gae_lambda"]).former != {}  # the file still has it
    text = configuration.dumps(configuration.loads((folder / "pbt.toml").read_text()))
    assert configuration.former_names(text) == {}
    (folder / "wrong.toml").write_text("[training.pbt]\nready = 9\nhyperparameters = [3]\n")
    with pytest.raises(ConfigError, match=r"^wrong\.toml:3: training\.pbt\.hyperparameters"):
        read(["wrong.toml"])


def test_a_population_of_an_older_league_goes_on_with_the_same_draws():
    """The numbers are those of commit 5e8de98, under the names of then."""
    own = {"gamma": 0.99, "gae_lambda": 0.95, "lr": 1e-3, "entropy_coef": 0.01}
    theirs = {"gamma": 0.9, "gae_lambda": 0.8, "lr": 1e-4, "entropy_coef": 0.1}
    pbt = Pbt(9, hyperparameters=("gamma", "lam", "lr", "entropy"), inherit=0.5, mutate=0.5)
    found = explore(own, theirs, own, pbt, np.random.default_rng(1))
    assert found == pytest.approx({"gamma": 0.988, "gae_lambda": 0.958333333, "lr": 1e-4, "entropy_coef": 0.01})


def test_a_hyperparameter_has_one_former_name():
    former = {each.name: each.metadata["formerly"] for each in settings(HappoConfig) if "formerly" in each.metadata}
    assert {name: former[name] for name in TUNABLE if name in former} == FORMER


def test_a_stored_text_is_asked_by_either_name():
    old, new = LeagueSettings("old", OLD), LeagueSettings("new", configuration.dumps(configuration.loads(OLD)))
    for text in (old, new):
        assert text.get("training", "rollout_length", otherwise=0) == text.get("training", "rollout", otherwise=0) == 24
        assert text.get("learner", "gae_lambda", otherwise=0.0) == 0.9


@pytest.mark.parametrize("preset", ["quickstart", "harl_a", "alphastar"])
def test_a_file_that_is_written_has_present_names_alone(folder, preset):
    assert init([str(folder), "--preset", preset]) == 0
    assert configuration.former_names((folder / "league.toml").read_text()) == {}


def test_the_page_of_settings_has_the_former_names():
    page = settings_page()
    for key, former in (("training.rollout_length", "rollout"), ("learner.gae_lambda", "lam")):
        (row,) = (line for line in page.splitlines() if line.startswith(f"| `{key}` |"))
        assert f"Formerly `{former}`." in row
