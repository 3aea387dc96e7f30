"""Lines that `league run` prints once, when a league begins."""

from league.commands.run import background
from league.config.experiment import Config
from league.runtime.preflight import Prepared
from league.state.league_state import LeagueState
from tests.league.leagues import CONFIG, filled

CHANGED = "mine.safetensors: An action of the rover means something else here than in race"


def test_what_starts_change_is_told_once_when_the_manager_leads(tmp_path, capsys):
    led = []
    prepared = Prepared("race", "c", 8, ("blue (1 × rover)", "red (1 × rover)"), starts=(CHANGED,))
    with filled(tmp_path / "store") as store:
        report = background._Reporter(store, Config(league="cup"), CONFIG, prepared, lambda: led.append(True))
        for _ in range(2):
            report(LeagueState.of(store, "cup"), "training", [])
    said = capsys.readouterr().out
    assert said.startswith("League cup: blue (1 × rover) against red (1 × rover) in race, engine c")
    assert said.count(f"  {CHANGED}") == 1
    assert led == [True]
