"""Metrics follow from rows alone: who broke a game lost it, seeds are compared, attackers count by their best."""

import json
from pathlib import Path

import pytest

from dashboards.web.document import document
from league.runs.bench import attackers, bench_page, entry_file, metrics, references, rerating
from league.runs.bench.games import batch_seed, match_of
from league.runs.bench.references import Reference, ReferenceSet
from league.runs.bench.tasks import find
from scripts import bench_references
from tests.league.conftest import ROOT

SUMO, PURSUIT = find("t1-sumo-rovers-v1"), find("t5-pursuit-v1")


def row(a: str, b: str, wins: int, draws: int, losses: int, **also):
    zero = {"first_side": [0, 0, 0], "seed_pairs": [0] * 5, "voids": 0, "voids_by_a": 0, "voids_by_b": 0, "steps": 1}
    return {"a": a, "b": b, "seed": batch_seed(SUMO, SUMO.seed, b, 0), "results": [wins, draws, losses], **zero, **also}


def scripts(*names: str, team: str | None = None) -> tuple[Reference, ...]:
    return tuple(Reference(name, "script", team) for name in names)


def test_a_game_that_its_own_robots_broke_is_lost():
    match = match_of(row("e1", "idle", 8, 0, 0, voids=3, voids_by_a=2), SUMO)
    assert (match.wins, match.losses, match.voids, match.voids_a) == (8, 2, 1, 0)


def test_who_breaks_more_than_a_hundredth_of_its_games_has_no_rank():
    known = ReferenceSet(scripts("idle"), (), "")
    for broken, ranked in ((1, True), (2, False)):
        rows = [row("e1", "idle", 100 - broken, 0, 0, voids=broken, voids_by_a=broken)]
        (found,) = metrics.metrics(SUMO, ["e1"], rows, known)["policies"]
        assert found["ranked"] is ranked
        assert found["own_voids"] == broken / 100


def test_the_stronger_of_two_has_the_higher_rating_and_the_worst_score_is_the_lowest():
    known = ReferenceSet(scripts("idle", "pusher"), (row("idle", "pusher", 10, 0, 54),), "")
    rows = [
        row("e1", "idle", 60, 0, 4), row("e1", "pusher", 32, 0, 32), row("e2", "idle", 32, 0, 32),
        row("e2", "pusher", 10, 0, 54), row("e1", "e2", 48, 0, 16),
    ]  # fmt: skip
    found = metrics.metrics(SUMO, ["e1", "e2"], rows, known)
    strong, weak = found["policies"]
    assert strong["rating"]["elo"] > 1000 > weak["rating"]["elo"]
    assert strong["worst"]["against"] == "pusher"
    assert strong["worst"]["score"] == 0.5
    assert found["relative_population_performance"] == {"blue": 0.5}  # e1 is better against both, and even with pusher
    assert found["cross_play"]["spread"] == 0.25


def test_a_rating_does_not_depend_on_the_policies_beside_it():
    known = ReferenceSet(scripts("idle", "pusher"), (row("idle", "pusher", 10, 0, 54),), "")
    rows = [row("e1", "idle", 60, 0, 4), row("e1", "pusher", 32, 0, 32)]
    other = [row("e2", "idle", 1, 0, 63), row("e2", "pusher", 1, 0, 63), row("e1", "e2", 64, 0, 0)]
    alone = metrics.metrics(SUMO, ["e1"], rows, known)["policies"][0]
    assert metrics.metrics(SUMO, ["e1", "e2"], rows + other, known)["policies"][0] == alone


def test_unlike_sides_are_rated_each_and_seeds_that_fit_each_other_are_seen():
    known = ReferenceSet(
        (*scripts("chaser:predators", team="predators"), *scripts("runner:prey", team="prey")),
        (row("chaser:predators", "runner:prey", 32, 0, 32),), "",
    )  # fmt: skip
    names = ["e1:predators", "e2:predators", "e1:prey", "e2:prey"]
    rows = [row(name, "runner:prey" if "pred" in name else "chaser:predators", 40, 0, 24) for name in names]
    rows += [row(names[i], names[2 + j], 16 if i == j else 48, 0, 48 if i == j else 16) for i in (0, 1) for j in (0, 1)]
    found = metrics.metrics(PURSUIT, names, rows, known)
    assert all(each["rating"]["elo"] > 1000 for each in found["policies"])
    assert found["cross_play"]["off_diagonal_less_diagonal"] == 0.5
    assert set(found["relative_population_performance"]) == {"predators", "prey"}


def test_the_best_attacker_counts_and_a_game_that_the_victim_broke_is_its_loss():
    about = {"policy": "e1", "times": 1, "attacker_steps": 64}
    rows = [
        about | row("attacker", "e1", 10, 0, 20, voids=2, voids_by_b=2) | {"attacker_seed": 1},
        about | row("attacker", "e1", 8, 0, 24) | {"attacker_seed": 2},
    ]
    (found,) = attackers.exploitability(SUMO, rows)
    assert (found["attacker_seed"], found["attacker_steps"], found["score"], found["over"]) == (1, 64, 12 / 32, -0.125)
    assert attackers.exploitability(SUMO, []) is None


def test_the_best_of_several_attackers_is_scored_by_the_games_that_did_not_choose_it():
    wins = {(1, False): 20, (1, True): 14, (2, False): 18, (2, True): 30}
    rows = [
        row("attacker", "e1", n, 0, 32 - n, policy="e1", times=1, attacker_steps=64, attacker_seed=seed, again=again)
        for (seed, again), n in wins.items()
    ]
    (found,) = attackers.exploitability(SUMO, rows)
    assert (found["attacker_seed"], found["score"], found["over"]) == (1, 14 / 32, -0.0625)
    (former,) = attackers.exploitability(SUMO, [row for row in rows if not row["again"]])
    assert (former["attacker_seed"], former["score"]) == (1, 20 / 32)
    entry = {"metrics": {"exploitability": [found]}, "attacks": rows}
    assert "the best of 2 in games of its own" in bench_page._attacked(entry, [{"name": "e1"}])


def test_the_first_policy_of_a_training_that_beats_the_middle_counts():
    middle = ReferenceSet((Reference("mid", "learnt", stage="middle"), Reference("idle", "script")), (), "")
    curve = [{"name": f"c{i}", "seconds": 60.0 * i} for i in (3, 2, 1)]
    rows = [row("c1", "mid", 47, 0, 17), row("c2", "mid", 48, 0, 16), row("c3", "mid", 60, 0, 4)]
    rows += [row("c1", "idle", 64, 0, 0)]
    assert metrics.seconds_to_75(SUMO, curve, rows, middle) == 120.0
    assert metrics.seconds_to_75(SUMO, curve[2:], rows, middle) is None
    another = ReferenceSet((*middle.references, Reference("new", "learnt", stage="middle")), (), "")
    assert metrics.seconds_to_75(SUMO, curve, rows, another) == 120.0  # one that was added since and not met


def test_rows_that_do_not_give_the_figures_are_told_with_both():
    known = references.of(SUMO)
    rows = [row("e1", name, 40, 0, 24) for name in known.names]
    told = {**metrics.metrics(SUMO, ["e1"], rows, known), "exploitability": None}
    content = {
        "name": "x", "task": SUMO.name, "references": known.digest, "policies": [{"name": "e1"}], "rows": rows,
        "games": 64, "trial": True, "seed": SUMO.seed, "attacks": [], "curve": [],
        "metrics": told | {"seconds_to_75": None},
    }  # fmt: skip
    assert rerating.differences(content) == []
    forged = content | {"rows": [row("e1", name, 41, 0, 23) for name in known.names]}
    lines = rerating.differences(forged)
    assert "policies[0].score.score is 0.625, and the rows give 0.640625" in lines
    assert any("rating.elo" in line for line in lines)
    assert "does not know" in rerating.differences(content | {"references": "another"})[0]


def test_an_entry_stays_where_references_were_added_since(monkeypatch):
    two = (row("idle", "pusher", 10, 0, 54),)
    former = ReferenceSet(scripts("idle", "pusher"), two, "former")
    today = ReferenceSet(scripts("idle", "pusher", "king"), (*two, row("king", "pusher", 60, 0, 4)), "today")
    monkeypatch.setattr(references, "_sets", lambda task: (today, today.only(("idle", "pusher"), "former")))
    rows = [row("e1", "idle", 60, 0, 4), row("e1", "pusher", 32, 0, 32)]
    told = {**metrics.metrics(SUMO, ["e1"], rows, former), "exploitability": None, "seconds_to_75": None}
    content = {
        "name": "x", "about": "", "task": SUMO.name, "references": "former", "policies": [{"name": "e1"}],
        "rows": rows, "attacks": [], "curve": [], "metrics": told, "games": 64, "trial": True, "package": "",
        "commit": None, "seed": SUMO.seed, "track": None,
    }  # fmt: skip
    assert rerating.differences(content) == []
    assert rerating.differences(content | {"rows": [rows[0], row("e1", "pusher", 30, 0, 34)]})
    among = rerating.of_today(content)["metrics"]["policies"][0]
    assert among["scores"] == told["policies"][0]["scores"]
    assert among["rating"]["elo"] < told["policies"][0]["rating"]["elo"]  # the new reference raises the mean
    assert rerating.of_today(content | {"references": "today"})["metrics"] is told
    text = document(bench_page.page({Path("x.json"): content}))
    assert "2 of 3" in text
    assert "Former references" not in text


def test_games_of_references_that_an_entry_played_count_once():
    pair, reverse = row("idle", "pusher", 10, 0, 54), row("pusher", "idle", 54, 0, 10)
    rows = [row("e1", "idle", 60, 0, 4), pair]
    once, same, turned = (
        metrics.metrics(SUMO, ["e1"], rows, ReferenceSet(scripts("idle", "pusher"), own, ""))["policies"][0]["rating"]
        for own in ((), (pair,), (reverse,))
    )
    assert once == same == turned


def test_a_set_of_references_is_kept_while_it_only_grows(tmp_path, monkeypatch):
    listed = {"references": [{"name": "idle"}, {"name": "pusher"}]}
    for number, met in enumerate((references.digest(listed), "another")):
        (tmp_path / f"{number}.json").write_text(json.dumps({"references": met}))
    monkeypatch.setattr(bench_references, "ENTRIES", tmp_path)
    bench_references.keep_former(listed, "king")
    kept = [{"digest": references.digest(listed), "names": ["idle", "pusher"]}]
    assert listed["former"] == kept
    listed["references"].append({"name": "king"})
    bench_references.keep_former(listed, "queen")  # no entry met the set of three
    assert listed["former"] == kept
    bench_references.keep_former(listed, "pusher")  # it changes, so that the set of two is gone
    assert "former" not in listed


@pytest.mark.slow
def test_the_entries_of_the_repository_are_what_their_rows_give():
    entries = entry_file.folder(ROOT / "benchmarks" / "entries")
    assert rerating.of_folder(entries) == {path: [] for path in entries}
