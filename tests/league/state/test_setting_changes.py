"""Settings that change between two runs of a league: told, and a learner's found in its snapshots' lineage."""

import json
from dataclasses import replace

import pytest

from league.commands.run.run import SettingChanges, _nothing_left
from league.config import experiment
from league.config.experiment import PlayerSettings
from league.state.setting_changes import learner_changes, lineage, run_changes, start_changed
from matchmaking.roles import Role
from storage.records import Snapshot
from storage.store import Store
from tests.league.conftest import call, said

PLAIN = experiment.default("rock-paper-scissors")


def text(**learner):
    return experiment.dumps(replace(PLAIN, learner=replace(PLAIN.learner, **learner)))


def snapshot(at, settings, parent=None):
    return Snapshot("cup", f"blue@{at}", "0", "chooser:1:3", "blue", parent=parent, settings=settings, iteration=at)


@pytest.mark.parametrize(("before", "now", "said"), [
    (text(), text(), []),
    ("", text(lr=0.5), []),  # a league that begins
    (text(lr=0.01), text(lr=0.5), ["learner.lr 0.01 -> 0.5"]),
    (text(), text(target_kl=0.02, gamma=0.9), ["learner.gamma 0.985 -> 0.9", "learner.target_kl none -> 0.02"]),
    (text(), text(architecture=replace(PLAIN.learner.architecture, hidden=(8,))),
     ["learner.architecture.hidden [64, 64] -> [8]"]),
    ("[learner]\nlr = 0.01\nlam = 0.5", text(lr=0.01), ["learner.gae_lambda 0.5 -> 0.95"]),  # by a former name
    ("[learner]\nlr = 'much'", text(), []),
    (text(class_="my/one.py:One", settings={"lr": 1}), text(class_="my/one.py:One", settings={"lr": 2, "more": True}),
     ["learner.settings.lr 1 -> 2", "learner.settings.more none -> true"]),
])  # fmt: skip
def test_what_changed_is_told_with_both_values(before, now, said):
    assert learner_changes(before, now) == said


def test_settings_of_other_players_are_no_part_of_a_players_lineage():
    before, red = PlayerSettings("blue", lr=0.1), PlayerSettings("red")
    one, other = (experiment.dumps(replace(PLAIN, players=(each, red))) for each in (before, replace(before, lr=0.2)))
    assert learner_changes(one, other) == ["players.blue.lr 0.1 -> 0.2"]
    assert learner_changes(one, other, "red") == []


def test_what_a_run_changes_beside_the_learner_is_told_by_key():
    one = replace(PLAIN, roles=(Role("main", timeout=1000),))
    other = replace(
        PLAIN, seed=5, roles=(Role("main", timeout=2000, win_rate=0.5),), learner=replace(PLAIN.learner, lr=0.5),
        training=replace(PLAIN.training, worlds=64, opponents=replace(PLAIN.training.opponents, kind="pfsp")),
        budget=replace(PLAIN.budget, steps=7),
    )  # fmt: skip
    assert run_changes(experiment.dumps(one), experiment.dumps(one)) == []
    assert sorted(run_changes(experiment.dumps(one), experiment.dumps(other))) == [
        "roles.main.timeout 1000 -> 2000", "roles.main.win_rate none -> 0.5", f"seed {PLAIN.seed} -> 5",
        'training.opponents.kind "latest" -> "pfsp"', "training.worlds none -> 64",
    ]  # fmt: skip
    assert run_changes("", experiment.dumps(other)) == []  # a league that begins
    assert run_changes("training = 3", experiment.dumps(other)) == []


def test_another_start_is_noticed():
    walk = experiment.dumps(replace(PLAIN, after=("anymal-walk",)))
    assert start_changed(experiment.dumps(PLAIN), walk)
    assert not start_changed(walk, walk)
    assert start_changed(walk, walk.replace("after_parts = []", 'after_parts = ["*"]'))
    assert not start_changed("after =", walk)


def test_another_start_of_a_player_is_noticed_and_a_further_player_is_none():
    def of(*players: PlayerSettings) -> str:
        return experiment.dumps(replace(PLAIN, players=players))

    blue, red, afresh = PlayerSettings("blue"), PlayerSettings("red"), PlayerSettings("blue", after=())
    assert start_changed(of(blue, red), of(afresh, red))
    assert not start_changed(of(afresh, red), of(afresh, red))
    assert not start_changed(of(blue, red), of(blue, red, replace(afresh, name="new")))


def test_the_snapshot_after_a_change_bears_it():
    kept = [snapshot(0, text()), snapshot(4, text(), "blue@0"), snapshot(8, text(lr=0.5), "blue@4"),
            snapshot(16, text(lr=0.5), "blue@8")]  # fmt: skip
    found = lineage([*kept, snapshot(2, text(), "gone@3")], "blue@16")
    assert [(each.snapshot.iteration, each.changes) for each in found] == [
        (0, ()), (4, ()), (8, ("learner.lr 0.001 -> 0.5",)), (16, ())
    ]  # fmt: skip
    assert [each.snapshot.name for each in lineage([snapshot(2, text(), "gone@3")], "blue@2")] == ["blue@2"]


def test_settings_of_a_run_without_work_are_named_as_unused_and_not_kept(copied_league, tmp_path):
    def kept() -> str:
        with Store.open(tmp_path / "league-data") as store:
            return store.league("tiny").config

    before, given = kept(), ("--learner.lr", "0.002", "--seed", "2", "--budget.rating_time", "0s")
    without = ("--workers.match", "0")
    done = call("run", *given, *without, "--budget.steps", "8192", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "other settings than before" not in done.stdout
    (told,) = [line for line in done.stdout.splitlines() if "has had its budget of 8,192 steps" in line]
    assert "these are not used: learner.lr 0.001 -> 0.002, seed 3 -> 2." in told
    assert told.endswith("To learn on with them, give them again with a larger budget or with --for or --steps.")
    assert kept() == before
    done = call("run", *given, *without, "--budget.steps", "10240", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Learns on with other settings than before: learner.lr 0.001 -> 0.002." in done.stdout
    assert "not used" not in done.stdout
    now = experiment.loads(kept())
    assert (now.learner.lr, now.seed, now.budget.steps) == (0.002, 2, 10_240)
    again = call("run", *given, *without, "--budget.steps", "10240", cwd=tmp_path)
    assert "has had its budget of 10,240 steps; `league run` goes on without one." in again.stdout


def test_a_run_without_work_says_what_uses_its_settings():
    spent = replace(PLAIN, league="cup", budget=replace(PLAIN.budget, training_time=None, steps=99))
    other = SettingChanges(settings=("seed 1 -> 2",))
    unused = "The league keeps the settings of its last run, and these are not used: seed 1 -> 2."
    assert _nothing_left(spent, SettingChanges()).endswith("99 steps; `league run` goes on without one.")
    again = "To learn on with them, give them again with a larger budget or with"
    assert _nothing_left(spent, other).endswith(f"99 steps. {unused} {again} --for or --steps.")
    assert _nothing_left(replace(spent, deterministic=True), other).endswith(f"{unused} {again} --steps.")
    nobody = replace(spent, budget=replace(spent.budget, steps=None))
    assert _nothing_left(nobody, other).endswith(f"`league status` tells why. {unused}")


@pytest.mark.slow
def test_a_run_with_another_rate_says_so_and_explain_keeps_record(copied_league, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    more = ("run", "--steps", "2048", "--budget.rating_time", "0s", "--workers.match", "0")
    done = call(*more, "--learner.lr", "0.002", "--seed", "2", "--after", "nobody", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Learns on with other settings than before: learner.lr 0.001 -> 0.002." in done.stdout
    assert "Goes on with other settings than before: seed 3 -> 2." in done.stdout
    assert 'after = ["nobody"] is for players that begin to learn: blue, red of league' in done.stdout
    code, out, _ = said(capsys, "explain", "blue@5", "--format", "json")
    found = json.loads(out)["lineage"]
    assert code == 0
    assert {row["snapshot"]: row["changes"] for row in found if row["changes"]} == {
        "blue@5": ["learner.lr 0.001 -> 0.002"]
    }
    assert found[0]["snapshot"] == "blue@0"
    code, _, err = said(capsys, "explain", "blue@99")  # on a slow machine 10 s of training end anywhere
    assert code == 2
    assert "no snapshot 'blue@99'" in err
