"""Networks that cannot go on from those that are there are refused in one line, and nothing is written."""

import re

import pytest

from league.snapshots.transfer import warm_start
from storage.store import Store
from tests.league.conftest import call

PENNIES = (
    "--arena.name", "matching-pennies", "--training.iterations_per_turn", "1", "--workers.match", "0",
    "--training.rollout_length", "32",
)  # fmt: skip


@pytest.mark.slow
def test_networks_that_a_player_does_not_have_are_refused_before_anything_is_written(tmp_path):
    first = call("run", *PENNIES, "--training.worlds", "16", "--steps", "512", cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    with Store.open(tmp_path / "league-data") as store:
        before = (store.revision("main"), store.league("main"), store.checkpoints("main"))
    for flag, says in (
        (("--learner.architecture.hidden", "8"), r"actor\.0\.trunk\.hidden\.0\.weight has the shape \[64, 1\] there "),
        (("--learner.critic_input", "same"), r"critic\.trunk\.observation_mean has the shape \[1\] there and \[4\] h"),
    ):
        refused = call("run", *PENNIES, "--training.worlds", "16", *flag, "--steps", "512", cwd=tmp_path)
        assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
        assert re.search(says, refused.stderr)
        with Store.open(tmp_path / "league-data") as store:
            assert (store.revision("main"), store.league("main"), store.checkpoints("main")) == before
    after = ("--league", "next", "--after", "main", "--learner.architecture.hidden", "8", "--steps", "512")
    refused = call("run", *PENNIES, *after, cwd=tmp_path)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
    assert re.search(
        r"after.* blue of league 'next' cannot go on from main blue: .* \[64, 1\] there and", refused.stderr
    )
    with Store.open(tmp_path / "league-data") as store:
        assert [league.name for league in store.leagues()] == ["main"]
        (blue, _) = sorted(store.players("main"), key=lambda p: p.team)
        for sees, goes_on in (("own", True), ("same", False)):
            assert bool(warm_start.of(store, [blue], ("main",), sees)["blue"].critic) == goes_on


@pytest.mark.slow
def test_a_policy_of_other_networks_to_start_from_is_refused_where_there_is_no_store_yet(tmp_path):
    refused = call("run", "--arena.name", "anymal-walk", "--after", "anymal-walk", "--steps", "512", cwd=tmp_path)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
    assert "cannot go on from anymal-walk blue@797" in refused.stderr
    assert not list(tmp_path.iterdir())
