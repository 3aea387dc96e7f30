"""A curriculum goes from stage to stage in one process, which waits where the store is away between two of them."""

import pytest

from league.commands.run import background
from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from storage.errors import Unavailable
from storage.records import League
from storage.store import Store

STAGES = """arena.name = "rock-paper-scissors"
[[stages]]
name = "near"
[stages.budget]
steps = 1000
[[stages]]
name = "far"
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that runs both stages, each of which does what it is given: leads, or raises."""
    config = configuration.loads(STAGES)
    spec = RunSpec.of(str(tmp_path / "store"), config)
    monkeypatch.setattr(background, "AWAY", 0.0)
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League(config.league, ""))

        def stages(*does: object) -> tuple[list[int], list[str]]:
            left, numbers, led = list(does), [], []

            def stage(store, where, config, number, on_lead, next_stage) -> bool:
                numbers.append(number)
                does = left.pop(0)
                if isinstance(does, Exception):
                    raise does
                on_lead()
                return bool(does)

            monkeypatch.setattr(background, "_run_stage", stage)
            background._run_stages(store, spec, config, lambda: led.append("leads"))
            assert store.league(config.league).config == spec.config_toml
            return numbers, led

        yield stages


def test_a_store_that_is_away_between_two_stages_is_waited_for(run, capsys):
    away = Unavailable("the disk is not mounted")
    assert run(True, away, away, True) == ([0, 1, 1, 1], ["leads"])
    assert capsys.readouterr().err == "league: waiting: the disk is not mounted; wait and try again.\n"


def test_a_store_that_is_away_before_anything_has_begun_is_an_error(run):
    with pytest.raises(Unavailable, match="not mounted"):
        run(Unavailable("the disk is not mounted"))


def test_no_stage_follows_one_that_was_stopped(run):
    assert run(False) == ([0], ["leads"])
