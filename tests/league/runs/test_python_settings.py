"""Settings from Python: mappings, presets, files, keywords, and what cannot be in one line."""

import numpy as np
import pytest

from league.config import experiment, presets
from league.config.schema import ConfigError
from league.runs.python_settings import config_of
from storage.records import League
from storage.store import Store


def test_keywords_lie_over_a_preset_a_mapping_a_config_and_a_file(tmp_path):
    (tmp_path / "l.toml").write_text('preset = "duel"\nlearner.lr = 0.25\nseed = 3\n')
    store = str(tmp_path / "none")
    for config in ("duel", {"preset": "duel", "learner": {"lr": 0.25}}, presets.preset("duel"), tmp_path / "l.toml"):
        found = config_of(config, {"learner.lr": np.float64(0.125), "budget": {"training_time": None}}, store)
        assert (found.league, found.learner.lr, found.budget.training_time) == ("duel", 0.125, None)
        assert found.budget.rating_time == "1m"
    assert config_of(tmp_path / "l.toml", {}, store) == experiment.load(tmp_path / "l.toml")
    assert config_of(presets.preset("duel"), {}, store) == presets.preset("duel")


def test_without_settings_it_is_the_league_run_last_else_the_quick_start(tmp_path):
    where = str(tmp_path / "store")
    assert config_of(None, {}, where) == presets.preset("quickstart")
    with Store.open(where, create=True) as store:
        for config in (presets.preset("duel"), presets.preset("psro")):
            store.create_league(League(config.league, experiment.dumps(config)))
        store.start_run("duel", "", "here", {})
    assert config_of(None, {}, where) == presets.preset("duel")
    assert config_of(None, {"league": "psro", "seed": 7}, where).training == presets.preset("psro").training
    assert config_of(None, {"arena": {"name": "matching-pennies"}}, where).league == "main"


@pytest.mark.parametrize(
    ("config", "settings", "says"),
    [
        ("dule", {}, "unknown preset 'dule': did you mean duel?"),
        ("none.toml", {}, "cannot read none.toml"),
        (7, {}, "no settings: 7; give a mapping"),
        ("duel", {"learner": {"lr": 3.0}}, "learner.lr = 3.0: must be between 0.0 and 1.0"),
        ({"learner": {"lrr": 3.0}}, {}, "unknown key learner.lrr: did you mean learner.lr?"),
        ({}, {"arena": {"name": "nowhere"}}, "unknown arena 'nowhere'"),
    ],
)
def test_settings_that_cannot_be_are_one_line(config, settings, says, tmp_path):
    with pytest.raises(ConfigError) as caught:
        config_of(config, settings, str(tmp_path / "none"))
    assert str(caught.value).startswith(says)
    assert "\n" not in str(caught.value)
