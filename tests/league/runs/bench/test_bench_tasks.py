"""The tasks are frozen: what the code builds today has their hashes and sides, and other code is refused."""

import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from league.config.schema import ConfigError
from league.runs.bench import evaluation, metrics, references
from league.runs.bench.games import bench_league
from league.runs.bench.tasks import TASKS, find
from league.snapshots import policy_file
from league.snapshots.codec import thaw
from scripts import bench_references
from storage.errors import StorageError

MOST = 11_000_000  # bytes that references add to the package
AGES = {"early", "middle", "late"}
LEARNT = tuple(name for name, task in TASKS.items() if not task.exact and name != "t3-soccer-2v2-v1")


@pytest.mark.parametrize("task", TASKS.values(), ids=lambda task: task.name)
def test_a_task_stays_what_it_was(task):
    arena = task.build()
    assert arena.config_hash == task.config_hash
    assert {team.name: team.roster for team in arena.teams} == dict(task.sides)
    assert arena.exchangeable or not task.alike


def test_code_with_other_rules_is_refused_and_told_what_to_install():
    with pytest.raises(ConfigError, match=r"frozen at configuration 0000.*install robot-league 0\.3\.0 with mujoco"):
        replace(find("t0-kuhn-poker-v1"), config_hash="0000").build()


@pytest.mark.parametrize("task", [t for t in TASKS.values() if not t.exact], ids=lambda task: task.name)
def test_all_references_can_sit_on_their_sides(task):
    known = references.of(task)
    assert len(set(known.names)) == len(known.names) > 1
    assert {each.team for each in known.references} == ({None} if task.alike else set(task.sides))
    with bench_league(task, 2) as league:
        for each in known.references:
            references.bring_in(league.opened, task, each)
        found = {s.name: s for s in league.opened.store.snapshots("bench")}
        for each in known.references:
            snapshot = found[each.name]
            assert snapshot.roster == task.sides[each.team or "blue"]
            assert thaw(league.opened.store, snapshot, league.evaluator.arena)
        assert {row[side] for row in known.rows for side in "ab"} <= set(known.names)


@pytest.mark.parametrize("name", LEARNT)
def test_each_side_has_a_learner_of_three_ages(name):
    task = find(name)
    known = references.of(task)
    for team in (None,) if task.alike else task.sides:
        learners: dict[str, dict[str, int]] = {}
        for each in known.of(team):
            if found := re.match(r"happo-\d+", each.name):
                learners.setdefault(found[0], {})[each.stage] = each.steps or 0
        whole = [steps for steps in learners.values() if steps.keys() == AGES]
        assert whole
        assert all(steps["early"] < steps["middle"] < steps["late"] for steps in whole)
        assert all(steps.keys() <= AGES and "late" in steps for steps in learners.values())


@pytest.mark.parametrize("name", LEARNT)
def test_games_of_all_references_come_with_the_package(name):
    task = find(name)
    known = references.of(task)
    assert not list(evaluation.missing(task, known, known.references))
    assert np.isfinite(metrics.rated(task, [], known).elo).all()


def test_reference_files_are_those_of_the_manifest_and_small():
    listed = {each.file for task in TASKS.values() for each in references.of(task).references if each.file}
    there = {file.name: file.stat().st_size for file in references.FOLDER.iterdir()}
    assert {name for name in there if name.endswith(".safetensors")} == listed
    assert all(re.fullmatch(r"[a-z0-9.-]+", name) for name in there)
    assert sum(there.values()) < MOST


@pytest.mark.parametrize("kind", ["learnt", "shipped"])
def test_a_reference_that_changed_is_noticed(kind, tmp_path, monkeypatch):
    own = next(each for each in references.of(find("t3-soccer-1v1-v1")).references if each.kind == kind)
    (tmp_path / references.checked_file(own).name).write_bytes(b"another")
    monkeypatch.setattr(references, "FOLDER", tmp_path)
    monkeypatch.setattr(policy_file, "TRAINED", tmp_path)
    with pytest.raises(StorageError, match="not the one of its manifest: reinstall"):
        references.checked_file(own)


def test_every_reference_that_is_no_script_is_frozen_by_its_digest():
    all_ = [each for task in TASKS.values() for each in references.of(task).references]
    assert {each.kind for each in all_ if not each.sha256} == {"script"}


def test_a_shipped_policy_is_listed_with_its_digest_and_meets_all_again(tmp_path, monkeypatch):
    task = find("t3-soccer-1v1-v1")
    listed = json.loads((references.FOLDER / "manifest.json").read_text("utf-8"))
    rows = json.loads((references.FOLDER / f"{task.name}.rows.json").read_text("utf-8"))
    (tmp_path / f"{task.name}.rows.json").write_text(json.dumps(rows), "utf-8")
    (tmp_path / "manifest.json").write_text(json.dumps(listed), "utf-8")
    monkeypatch.setattr(bench_references, "FOLDER", tmp_path)
    monkeypatch.setattr(bench_references, "MANIFEST", tmp_path / "manifest.json")
    entered = bench_references.add_shipped(task, "leatherback-score", "red", "again")
    assert (entered.kind, entered.policy, entered.team) == ("shipped", "leatherback-score", "red")
    assert entered.sha256 == hashlib.sha256(policy_file.find("leatherback-score").read_bytes()).hexdigest()
    left = json.loads((tmp_path / f"{task.name}.rows.json").read_text("utf-8"))
    assert left == [row for row in rows if "leatherback-score" not in (row["a"], row["b"])]
    assert len(left) < len(rows)


def test_a_shared_actor_is_stored_once_and_unlike_actors_each():
    stored = policy_file.read(references.FOLDER / "t5-pursuit-happo-1-late-predators.safetensors")
    team = references.copied(stored, find("t5-pursuit-v1").sides["predators"], 3)
    one, copies = bench_references.of_one_agent(team)
    assert copies == 3
    assert one.about["roster"] == stored.about["roster"]
    assert one.arrays.keys() == stored.arrays.keys()
    assert all(np.array_equal(one.arrays[name], stored.arrays[name]) for name in one.arrays)
    unlike = policy_file.read(references.FOLDER / "t1-sumo-rovers-happo-101-late.safetensors")
    assert bench_references.of_one_agent(unlike) == (unlike, 1)
