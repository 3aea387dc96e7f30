"""The bench as a stranger uses it: an ONNX file from the command line to the page, and every refusal in one line."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from dashboards.web.document import document
from league.commands import cli
from league.matches.exact_exploitability import KnownGame
from league.matches.exploitability import begin
from league.runs.bench import attackers, bench_page, entrants, entry_file, references, rerating
from league.runs.bench.games import bench_league
from league.runs.bench.partial_rows import PartialRows
from league.runs.bench.tasks import TASKS
from tests.league.conftest import said, start
from tests.league.runs.bench.files import network
from tests.league.snapshots.test_programs import gemm

SUMO, UNLIKE, KUHN = "t1-sumo-rovers-v1", "t2-sumo-unlike-v1", "t0-kuhn-poker-v1"
ENTRIES = Path(__file__).parents[4] / "benchmarks" / "entries"
SHIPPED = ("blue=anymals-sumo", "red=leatherbacks-sumo")
SLOW = "import time\nimport numpy as np\n\ndef slow(x):\n    time.sleep(0.2)\n    return np.zeros((len(x), 2))\n"


@pytest.fixture(scope="module")
def entry(tmp_path_factory):
    """The folder with a stranger's ONNX file, and the entry that was played with it."""
    folder = tmp_path_factory.mktemp("bench")
    mine = gemm(folder / "mine.onnx", sees=38, acts=2, bias=(1.0, 0.0))
    (folder / "entries").mkdir()
    out = folder / "entries" / "mine.json"
    words = ["--entry", mine, "--games", "8", "--against", "idle,pusher", "--name", "mine", "--about", "a <b>layer</b>"]
    words += ["--track", "30min-cpu"]
    with pytest.raises(SystemExit) as ended:
        cli.main(["bench", SUMO, *words, "--out", str(out)])
    assert not ended.value.code
    return out


def test_a_strangers_onnx_file_goes_through_the_bench(entry):
    content = entry_file.read(entry)
    (policy,) = content["metrics"]["policies"]
    assert {row["b"] for row in content["rows"] if row["a"] == "e1"} == {"idle", "pusher"}
    assert [each["games"] + each["voids"] for each in policy["scores"]] == [8, 8]
    assert policy["worst"]["score"] <= policy["score"]["score"]
    assert content["trial"]
    assert content["policies"][0]["kind"] == "onnx"
    assert content["metrics"]["exploitability"] is None  # not measured
    assert list(entry.parent.iterdir()) == [entry]  # the rows so far are no longer needed


def test_what_it_tells_follows_from_its_rows(entry, capsys):
    code, out, _ = said(capsys, "bench", "rerate", str(entry.parent))
    assert (code, "the same" in out) == (0, True)
    content = entry_file.read(entry)
    found = rerating.again(content, references.of(TASKS[SUMO]))
    assert found["policies"] == content["metrics"]["policies"]


def test_its_page_shows_it_and_asks_for_nothing(entry, tmp_path, capsys):
    page = tmp_path / "bench.html"
    assert said(capsys, "bench", "page", str(entry.parent), "--out", str(page))[0] == 0
    text = page.read_text("utf-8")
    assert "Content-Security-Policy" in text
    assert "default-src 'none'" in text
    assert "a &lt;b&gt;layer&lt;/b&gt;" in text
    assert re.search(r"<td[^>]*>trial</td>", text)
    assert re.search(r"<td[^>]*>30min-cpu</td>", text)


def test_the_page_has_the_cross_play_of_seeds():
    entries = {path: entry_file.read(path) for path in ENTRIES.glob("t[12]-*-latest.json")}
    assert {entry["task"] for entry in entries.values()} == {SUMO, UNLIKE}
    text = document(bench_page.page(entries))
    assert "2.7 from ½" in text
    assert "+2.5 off the diagonal" in text


def test_policies_beside_an_entry_are_those_that_it_names():
    folders = [path for path in ENTRIES.iterdir() if path.is_dir()]
    assert folders
    for folder in folders:
        content = entry_file.read(ENTRIES / f"{folder.name}.json")
        found = entrants.read(TASKS[content["task"]], [str(path) for path in sorted(folder.iterdir())])
        assert [each.digest for each in found] == [each["sha256"] for each in content["policies"]]


def test_an_edited_entry_is_refused_by_page_and_count(entry, tmp_path, capsys):
    content = json.loads(entry.read_text())
    content["metrics"]["policies"][0]["rating"]["elo"] += 100
    (tmp_path / "mine.json").write_text(json.dumps(content))
    for command in (("rerate", str(tmp_path)), ("page", str(tmp_path), "--out", str(tmp_path / "x.html"))):
        code, _, err = said(capsys, "bench", *command)
        assert (code, err.count("\n"), "was edited" in err) == (2, 1, True)
    assert not (tmp_path / "x.html").exists()


def test_a_forged_entry_is_noticed_by_its_rows(entry, tmp_path, capsys):
    content = json.loads(entry.read_text())
    content["metrics"]["policies"][0]["rating"]["elo"] += 100
    del content["digest"]
    entry_file.write(tmp_path / "mine.json", content)
    code, out, _ = said(capsys, "bench", "rerate", str(tmp_path))
    assert code == 1
    assert "rating.elo is" in out
    code, _, err = said(capsys, "bench", "page", str(tmp_path), "--out", str(tmp_path / "x.html"))
    assert (code, err.count("\n"), "contradicts itself" in err) == (2, 1, True)


@pytest.mark.parametrize(("key", "value"), [("trial", False), ("games", 2048), ("seed", 7)])
def test_a_trial_that_was_forged_into_a_record_is_noticed(key, value, entry, tmp_path, capsys):
    content = json.loads(entry.read_text())
    del content["digest"]
    entry_file.write(tmp_path / "mine.json", content | {key: value})
    code, out, _ = said(capsys, "bench", "rerate", str(tmp_path))
    assert (code, f"{key} is {value}, and" in out) == (1, True)


@pytest.mark.parametrize(("change", "why"), [({"track": "1d"}, "names the track '1d', and"), ({"track": 3}, "type")])
def test_a_track_that_a_task_does_not_have_is_refused(change, why, entry, tmp_path, capsys):
    entry_file.write(tmp_path / "mine.json", json.loads(entry.read_text()) | change)
    code, _, err = said(capsys, "bench", "rerate", str(tmp_path))
    assert (code, err.count("\n"), why in err) == (2, 1, True), err


def test_an_entry_without_a_track_is_read_as_before(entry, tmp_path):
    content = json.loads(entry.read_text())
    del content["track"]
    entry_file.write(tmp_path / "mine.json", content)
    assert entry_file.read(tmp_path / "mine.json")["track"] is None


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("t3-soccer-1v1-v1", ["Leatherback (red/0) sees 24", "40 rad/s per unit"]),
        ("t4-galaga-1v1-v1", ["Minitank (blue/0) sees 18", "Crazyflie (red/0) sees 20"]),
    ],
)
def test_a_tasks_command_describes_its_own_observations_and_units(name, words, capsys):
    command = next(line for line in said(capsys, "bench", name)[1].splitlines() if line.startswith("What robots see"))
    given = command.partition(": league ")[2].split()
    described = said(capsys, *given)[1]
    assert [word for word in words if word not in described] == []
    settings = json.loads(said(capsys, *given, "--format", "json")[1])["settings"]
    assert settings  # tables of settings are part of it


@pytest.mark.parametrize(
    "change", [{"rows": [{"a": "e1", "b": "idle"}]}, {"name": 3}, {"policies": [{}]}, {"rows": []}]
)
def test_an_entry_of_another_form_is_refused_in_one_line(change, entry, tmp_path, capsys):
    content = {**json.loads(entry.read_text()), **change}
    entry_file.write(tmp_path / "mine.json", content)
    for command in (("rerate", str(tmp_path)), ("page", str(tmp_path), "--out", str(tmp_path / "x.html"))):
        code, _, err = said(capsys, "bench", *command)
        assert (code, err.count("\n")) == (2, 1), err


def test_an_entry_against_former_references_is_listed_apart(entry, tmp_path, capsys):
    content = json.loads(entry.read_text()) | {"references": "0" * 64}
    entry_file.write(tmp_path / "mine.json", content)
    assert said(capsys, "bench", "page", str(tmp_path), "--out", str(tmp_path / "x.html"))[0] == 0
    assert "Former references" in (tmp_path / "x.html").read_text("utf-8")


def test_an_exact_entry_has_the_exploitability_of_its_policy(tmp_path, capsys):
    file = network(tmp_path / "mine.safetensors", TASKS[KUHN].sides["blue"])
    code, out, err = said(capsys, "bench", KUHN, "--entry", file, "--out", str(tmp_path / "kuhn.json"))
    assert code == 0, err
    content = entry_file.read(tmp_path / "kuhn.json")
    (policy,) = content["metrics"]["policies"]
    assert 0 < policy["exploitability"] < 1
    assert policy["exploitability"] != pytest.approx(KnownGame("kuhn-poker").of_uniform().exploitability, abs=1e-4)
    assert f"(mine.safetensors): exact exploitability {policy['exploitability']:.6f}" in out
    assert rerating.differences(content) == []
    content["rows"][0]["table"][0] = [1.0, 0.0]
    assert rerating.differences(content)


REFUSED = {
    "another roster": ([SUMO, "--entry", "leatherbacks-sumo"], "leatherbacks-sumo is a policy for leatherback:14:2"),
    "no such task": (["t9", "--entry", "x.onnx"], "There is no task 't9' here; there is: t0-dark-hex-3-v1,"),
    "no such file": ([SUMO, "--entry", "gone.onnx"], "gone.onnx"),
    "not finite": ([SUMO, "--entry", "{nan}"], "agent 0's mean.bias is not finite"),
    "too slow": ([SUMO, "--entry", "{slow}:slow"], "is too slow: decisions take"),
    "twice": ([SUMO, "--entry", "{one}", "{copy}"], "is the same policy as one.safetensors: give each once"),
    "too large": ([SUMO, "--entry", "{large}"], "is too large: it has 4,000,079 parameters, and 4,000,000 are"),
    "an empty file": ([SUMO, "--entry", "{one},"], "names no file beside one of its commas"),
    "an empty side": ([UNLIKE, "--entry", "blue=", "red=x.pt"], "blue= names no file at all"),
    "nothing": ([SUMO, "--entry"], "--entry names no policy"),
    "no function": ([SUMO, "--entry", "{slow}"], "slow.py is a Python file: name its function"),
    "a missing side": ([UNLIKE, "--entry", "blue=anymals-sumo"], "a policy for red is missing (1 for blue and 0"),
    "a side unnamed": ([UNLIKE, "--entry", "anymals-sumo"], "does not name its side"),
    "a side misspelt": ([UNLIKE, "--entry", "bleu=x.onnx", "red=y.onnx"], "has no side 'bleu', and takes"),
    "sides that are alike": ([SUMO, "--entry", "green=x.onnx"], "are alike; give --entry FILE, no green="),
    "odd games": ([SUMO, "--entry", "{one}", "--games", "7"], "--games is 7: it must be even"),
    "no curve": ([SUMO, "--entry", "{one}", "--curve", "{slow}"], "line 1: 'import time' is not SECONDS,FILE"),
    "an empty curve": ([SUMO, "--entry", "{one}", "--curve", "{empty}"], "empty.csv is empty: its lines are"),
    "unlike sides": ([UNLIKE, "--entry", *SHIPPED, "--curve", "{curve}"], "--curve is for tasks of like sides, and"),
    "no such reference": ([SUMO, "--entry", "{one}", "--against", "king"], "There is no reference 'king'"),
    "no such track": ([SUMO, "--entry", "{one}", "--track", "1d"], "--track is '1d', and t1-sumo-rovers-v1 has 50M,"),
    "an exact task's track": ([KUHN, "--entry", "{one}", "--track", "1h"], "t0-kuhn-poker-v1 has no tracks"),
    "no task": (["--name", "x"], "league bench needs a TASK"),
    "a program in an exact task": ([KUHN, "--entry", "{kuhn}"], "is a program, whose probabilities cannot be read"),
    "games in an exact task": ([KUHN, "--entry", "{kuhn}", "--attack", "9"], "--attack is for games, and t0-kuhn"),
    "no place": ([SUMO, "--entry", "{one}", "--out", "gone/x.json"], "gone"),
    "no entries": (["page", "{folder}"], "has no entry"),
    "no folder": (["rerate", "gone"], "gone is no folder"),
}  # fmt: skip


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    rovers = TASKS[SUMO].sides["blue"]
    (folder / "slow.py").write_text(SLOW)
    (folder / "curve.csv").write_text("60,anymals-sumo\n")
    (folder / "empty.csv").touch()
    found = {
        "nan": network(folder / "nan.safetensors", rovers, broken=True), "slow": str(folder / "slow.py"),
        "one": network(folder / "one.safetensors", rovers), "copy": str(folder / "copy.safetensors"),
        "kuhn": gemm(folder / "kuhn.onnx", sees=10, acts=2), "folder": str(folder),
        "curve": str(folder / "curve.csv"), "empty": str(folder / "empty.csv"),
        "large": gemm(folder / "large.onnx", sees=38, acts=2),
    }  # fmt: skip
    model = onnx.load(found["large"])
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.zeros(4_000_001, np.int8), "idle"))
    onnx.save(model, found["large"])
    shutil.copy(found["one"], found["copy"])
    return found


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_refused_in_one_line(case, bad, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, why = REFUSED[case]
    code, out, err = said(capsys, "bench", *(word.format(**bad) for word in words))
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert why in err
    assert not list(tmp_path.iterdir())


def test_an_entry_is_never_written_over(entry, bad, capsys):
    before = entry.read_bytes()
    code, _, err = said(capsys, "bench", SUMO, "--entry", bad["one"], "--out", str(entry))
    assert (code, "exists: give another --out" in err) == (2, True)
    assert entry.read_bytes() == before


@pytest.mark.slow
def test_what_ctrl_c_stops_goes_on(bad, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    out, partial = tmp_path / "x.json", tmp_path / "x.json.part"
    words = ["bench", SUMO, "--entry", bad["one"], "--games", "16", "--against", "idle,pusher", "--out", str(out)]
    with start(*words, cwd=home) as process:
        while not partial.exists():
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    assert f"stopped; what was played is in {partial}" in (home / "out.txt").read_text()
    assert not out.exists()
    kept = json.loads(partial.read_text())
    kept["rows"][0]["steps"] += 1  # a mark: the batch is not played again
    partial.write_text(json.dumps(kept))
    done = subprocess.run([sys.executable, "-m", "league", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = entry_file.read(out)["rows"]
    assert kept["rows"] == rows[: len(kept["rows"])]
    assert {row["b"] for row in rows if row["a"] == "e1"} == {"idle", "pusher"}
    assert {each.name for each in tmp_path.iterdir()} == {out.name, home.name}


def test_an_attack_that_ctrl_c_stops_goes_on_too(bad, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(attackers, "train_attacker", lambda *_: None)  # as where its manager took the signal
    words = ["bench", SUMO, "--entry", bad["one"], "--games", "8", "--against", "idle", "--attack", "1"]
    code, _, err = said(capsys, *words, "--out", str(tmp_path / "x.json"))
    assert code == 130
    assert "x.json.part, and the same command goes on from there" in err
    assert len(json.loads((tmp_path / "x.json.part").read_text())["rows"]) == 1


@pytest.mark.slow
def test_of_several_attackers_each_plays_again_and_a_resumed_bench_makes_none_of_them_again(bad, tmp_path, monkeypatch):
    def unlearnt(opened, where, chosen):
        """Return the victim itself as an attacker that has learnt, in place of minutes of training."""
        begin(opened.store, chosen)
        attacker = replace(opened.snapshot(chosen.victim.name), league=chosen.config.league, player=chosen.player)
        return replace(attacker, name=f"{chosen.player}@{chosen.config.budget.steps}", iteration=1)

    task, partial = TASKS[SUMO], tmp_path / "rows"
    (entrant,) = entrants.read(task, [bad["one"]])
    monkeypatch.setattr(attackers, "train_attacker", unlearnt)
    monkeypatch.setattr(attackers, "TIMES", (1,))  # each match compiles for seconds
    with bench_league(task, 8) as opened:
        entrant.add_to(opened.opened)
        rows = attackers.attacks(opened, ["e1"], 1, (1, 2), 8, PartialRows(partial, {}))
        monkeypatch.setattr(attackers, "train_attacker", lambda *_: pytest.fail("it was trained before"))
        resumed = [attackers.attacks(opened, ["e1"], 1, seeds, 8, PartialRows(partial, {})) for seeds in ((1, 2), (1,))]
    asked = [(row["attacker_seed"], row["again"]) for row in rows]
    assert asked == [(1, False), (1, True), (2, False), (2, True)]
    assert len({row["seed"] for row in rows}) == len(rows)  # no games twice
    assert resumed == [rows, rows[:1]]


def test_tasks_are_listed_and_described(capsys):
    assert all(name in said(capsys, "bench", "--list")[1] for name in TASKS)
    out = said(capsys, "bench", UNLIKE)[1]
    assert "anymal:56:12+anymal:56:12" in out
    assert "wait for GPU time" in out
    assert "--entry blue=FILE red=FILE" in out
