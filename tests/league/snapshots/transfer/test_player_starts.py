"""A league whose players start from different leagues: what each one takes over, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from league.commands.run.next_stage import compile_rollout
from league.config import experiment as configuration
from league.config.sections import PlayerSettings
from league.system import arena_build
from storage.blobs import arrays
from storage.store import Store
from tests.league.conftest import BODILESS, call

SETTINGS = """
{start}
[[players]]
team = "blue"
[[players]]
team = "red"
[[players]]
team = "blue"
name = "new"
after = []
[[players]]
team = "red"
name = "copy"
after = ["tiny/blue@1"]
"""


def run(folder, name: str, start: str):
    (folder / "next.toml").write_text(SETTINGS.format(start=start))
    flags = ("--league", name, "--budget.rating_time", "0s", "--workers.match", "0", "--steps", "2048")
    return call("run", str(folder / "next.toml"), *BODILESS, *flags, "--store", str(folder / "league-data"), cwd=folder)


@pytest.mark.slow
@pytest.mark.parametrize("start", ['after = ["tiny"]', ""], ids=["beside the league's", "alone"])
def test_each_player_starts_from_its_own(copied_league, tmp_path, start):
    name = "next" if start else "alone"
    done = run(tmp_path, name, start)
    assert done.returncode == 0, done.stderr
    assert "copy: actors go on from tiny/blue@1's blue@1/0; critic starts afresh" in done.stdout
    assert "new: actors start afresh; critic starts afresh" in done.stdout
    with Store.open(tmp_path / "league-data") as store:
        first = {s.player: s for s in store.snapshots(name) if s.iteration == 0}
        own = {s.name: s for s in store.snapshots("tiny")}

        def policy(snapshot):
            return arrays.from_bytes(store.blobs.get(snapshot.digest))

        def equal(one, other) -> bool:
            return all(np.array_equal(value, policy(other)[key]) for key, value in policy(one).items())

        assert equal(first["copy"], own["blue@1"])
        newest = [s for s in own.values() if s.player == "blue"][-1]
        assert equal(first["blue"], newest) == bool(start)
        assert not equal(first["new"], newest)
        assert first["new"].parent is None
        assert first["copy"].parent == "tiny/blue@1"


def test_a_start_that_is_not_there_is_refused_by_one_line(copied_league, tmp_path):
    (tmp_path / "gone.toml").write_text('players = [{team = "blue"}, {team = "red", after = ["gone"]}]\n')
    done = call("run", str(tmp_path / "gone.toml"), *BODILESS, "--league", "third", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "no league or trained policy 'gone'" in done.stderr


def test_a_rollout_is_compiled_ahead_whatever_players_start_from():
    players = (PlayerSettings("blue", after=("elsewhere",)), PlayerSettings("red"))
    config = replace(configuration.default("rock-paper-scissors"), players=players, after=("gone",))
    config = replace(config, training=replace(config.training, worlds=64))
    compile_rollout(config, arena_build.build(config, 64), 64)
    assert config.afresh.every_after == ()
