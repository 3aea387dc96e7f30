"""The commands as a user types them, against one league that was really trained, rated and recorded.

Each runs in a process of its own at least once; what else is asked of it is asked in this process.
"""

import csv
import io
import json
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import league
from league.commands.cli import main
from league.queries.match_players import players_of
from league.queries.query import Open
from league.queries.recordings import RecordingQuery, chosen, load
from storage.errors import StorageError
from storage.recordings.recording import headers
from storage.store import Store
from tests.league.conftest import ENVIRONMENT, ROOT, TINY, call, said
from tests.markup import Markup


def test_a_run_learns_rates_and_says_what_to_type_next(tiny_league):
    _, printed = tiny_league
    assert re.search(r"^(starting|compiling)\b.* so far", printed, re.MULTILINE)
    assert re.search(r"^done · .*blue@\d+ \d+ %.*vs initial", printed, re.MULTILINE)
    assert "blue@0" in printed
    assert "league watch" in printed
    assert "its own blue@0" in printed


def test_ratings_say_the_same_in_every_format(tiny_league, monkeypatch, capsys):
    folder, _ = tiny_league
    monkeypatch.chdir(folder)
    table = call("ratings", cwd=folder).stdout
    rows = json.loads(said(capsys, "ratings", "--format", "json")[1])
    lines = list(csv.DictReader(io.StringIO(said(capsys, "ratings", "--format", "csv")[1])))
    assert [row["name"] for row in rows] == [line["name"] for line in lines]
    assert all(row["name"] in table for row in rows)
    rated = [row for row in rows if row["elo"] is not None]
    known = [row for row in rated if row["known"]]
    assert known == sorted(known, key=lambda row: -row["low"])
    assert all(row["low"] < row["elo"] < row["high"] for row in rated if row["iteration"] != 0)
    assert {"idle", "random", "pusher", "centre-holder"} <= {row["name"] for row in rows}


def test_the_report_is_of_the_league_that_was_run(tiny_league, monkeypatch, capsys):
    folder, _ = tiny_league
    monkeypatch.chdir(folder)
    done = call("report", "-o", "report.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    page = Markup((folder / "report.html").read_text("utf-8"))
    rows = json.loads(said(capsys, "ratings", "--format", "json")[1])
    assert [row[1] for row in page.tables["Ladder, best first"][1:]] == [row["name"] for row in rows]
    assert {name.partition("-")[0] for name in page.figures} >= {"ladder", "ratings", "payoff", "curves", "lineage"}
    steps = [trace["x"] for name, figure in page.figures.items() if "curves" in name for trace in figure["data"]]
    assert all(x == sorted(x) and x for x in steps)
    assert not [link for link in page.links if not link.startswith(("#", "data:"))]


def test_learning_shows_in_the_score_against_the_initial_snapshot(tiny_league):
    folder, _ = tiny_league
    with league.open(str(folder / "league-data")) as opened:
        ratings = opened.ratings()
        newest = ratings[ratings.player.notna()].sort_values("iteration").groupby("player").last()
        assert newest.vs_initial.notna().all()
        # 33,000 steps took the prototype past 0.9; a policy that learnt nothing scores a half.
        assert (newest.vs_initial > 0.6).all()


def test_the_match_log_adds_up(tiny_league):
    folder, _ = tiny_league
    with league.open(str(folder / "league-data")) as opened:
        log = opened.store.matches(opened.league)
        assert len(log) == len(opened.matches()) > 0
    for match in log:
        games = match.wins + match.draws + match.losses
        assert games + match.voids == 32
        assert 2 * sum(match.pairs) == games or match.voids
        assert sum((match.side_wins, match.side_draws, match.side_losses)) == 16 or match.voids
        first, swapped = headers(opened.store.blobs.get(match.recording))
        assert (first.sides, swapped.sides) == ((match.a, match.b), (match.b, match.a))
        assert first.seed == swapped.seed == match.seed


def test_snapshots_stand_on_a_logarithmic_axis(tiny_league):
    folder, _ = tiny_league
    with league.open(str(folder / "league-data")) as opened:
        blue = [s for s in opened.store.snapshots(opened.league) if s.player == "blue"]
        assert {0, 1, 2, 4, 8, 16} <= {s.iteration for s in blue}
        milestone = next((s for s in blue if s.seconds >= 1), blue[-1])  # `rating.milestones` of this league is 1 s
        others = {s.iteration for s in blue} - {0, 1, 2, 4, 8, 16}
        assert others <= {milestone.iteration, blue[-1].iteration}
        assert len({s.digest for s in blue}) == len(blue)


def test_the_same_command_does_not_train_beyond_its_budget(tiny_league, tmp_path):
    folder, _ = tiny_league
    shutil.copytree(folder / "league-data", tmp_path / "league-data")
    again = call(
        "run", *TINY, "--budget.steps", "33000", "--budget.rating_time", "0s", "--workers.match", "0", cwd=tmp_path
    )
    assert again.returncode == 0, again.stderr
    assert "has had its budget of 33,000 steps" in again.stdout


def test_watch_writes_a_file_for_rerun_and_a_picture(graphics, tiny_league, tmp_path):
    folder, _ = tiny_league
    saved, shot = tmp_path / "match.rrd", tmp_path / "match.png"
    done = call("watch", "--save", str(saved), "--shot", str(shot), cwd=folder)
    assert done.returncode == 0, done.stderr
    assert saved.stat().st_size > 10_000
    with Open(Store.open(folder / "league-data")) as opened:
        newest = chosen(opened, RecordingQuery())
        performers = players_of(opened, newest, load(opened, newest)[0].header.sides)
    with Image.open(shot) as picture:
        scene = _chroma(np.asarray(picture.convert("RGB"))[40:, : picture.width * 7 // 10])
    strength = np.linalg.norm(scene, axis=-1)
    for who in performers:  # a script is green, and in light and shade a hue is the same
        hue = _chroma(np.array(who.colour))
        alike = scene @ hue > 0.97 * strength * np.linalg.norm(hue)
        assert np.sum(alike & (strength > 30)) > 500, who


def _chroma(rgb):
    """What is not grey of a colour (..., 3)."""
    return rgb - rgb.mean(axis=-1, keepdims=True)


def test_status_and_stop_of_a_league_that_does_not_run(tiny_league):
    folder, _ = tiny_league
    assert "League tiny: stopped" in call("status", cwd=folder).stdout
    assert "is not running" in call("stop", cwd=folder).stdout


def test_init_writes_a_file_that_run_accepts_and_never_overwrites(tmp_path, monkeypatch, capsys):
    assert call("init", cwd=tmp_path).returncode == 0
    before = (tmp_path / "league.toml").read_bytes()
    monkeypatch.chdir(tmp_path)
    assert said(capsys, "init", "--preset", "duel")[0] == 2
    assert (tmp_path / "league.toml").read_bytes() == before
    code, out, _ = said(capsys, "run", "league.toml", "--help")
    assert code == 0
    assert "--learner.gamma" in out


def test_the_commands_of_the_readme_exist(capsys):
    blocks = re.findall(r"^```(?:bash|sh|console)\n(.*?)^```", (ROOT / "README.md").read_text(), re.S | re.M)
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("league ")]
    assert len(commands) >= 5
    for args in commands:
        with pytest.raises(SystemExit) as ended:
            main([args[0], "--help"])
        told = capsys.readouterr()
        assert ended.value.code == 0, f"league {args[0]}: {told.err}"
        for flag in (a for a in args if a.startswith("--")):
            assert flag.split("=")[0] in told.out, f"README uses league {args[0]} {flag}"


def test_the_python_example_of_the_readme_runs(tiny_league):
    folder, _ = tiny_league
    (example,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.S | re.M)
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=folder, capture_output=True, text=True, timeout=540,
        env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("rating",), "did you mean ratings"),
        (("run", "--preset", "quikstart"), "did you mean quickstart"),
        (("run", "--arena.name", "sumo-2v3"), "did you mean sumo-2v2"),
        (("run", "nowhere.toml"), "cannot read nowhere.toml"),
        (("run", "--for", "soon"), '"soon" is not a duration'),
        (("run", "--learner.gamma", "1.5"), "learner.gamma = 1.5: must be between 0"),
        (("run", "bad.toml"), "bad.toml:2: learner.gamma = 1.5"),
        (("run", "--training.wrlds", "9"), "--training.worlds"),
        (("ratings", "--format", "xml"), "table"),
        (("ratings", "--store", "nowhere"), "No league store"),
        (("ratings", "--store", "text.db"), "text.db"),
        (("ratings", "--store", "ftp://host/league"), "ftp"),
        (("watch", "7"), "No league store"),
        (("check", "sumo-9v9"), "unknown arena"),
        (("check", "missing.py:duel"), "no arena file missing.py"),
    ],
)
def test_bad_input_is_told_in_one_breath_and_leaves_nothing(args, says, tmp_path, monkeypatch, capsys):
    (tmp_path / "text.db").write_text("not a store")
    (tmp_path / "bad.toml").write_text("[learner]\ngamma = 1.5\n")
    monkeypatch.chdir(tmp_path)
    code, out, err = said(capsys, *args)
    assert code == 2, out + err
    assert says in err
    assert "Traceback" not in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.toml", "text.db"]


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("ratings", "--league", "tinny"), "Did you mean 'tiny'"),
        (("watch", "999"), "There is no match 999"),
        (("run", "--league", "tiny", "--arena.name", "sumo-2v2"), "cannot go on in sumo-2v2: its player blue fits"),
    ],
)
def test_a_wrong_name_in_a_good_store(args, says, tiny_league, monkeypatch, capsys):
    folder, _ = tiny_league
    monkeypatch.chdir(folder)
    code, _, err = said(capsys, *args)
    assert code == 2
    assert says in err
    assert len(err.strip().splitlines()) == 1


def test_a_damaged_recording_is_named(tiny_league, tmp_path):
    import shutil

    folder, _ = tiny_league
    copy = tmp_path / "league-data"
    shutil.copytree(folder / "league-data", copy)
    with league.open(str(copy)) as opened:
        match = opened.store.matches(opened.league)[0]
    (blob,) = [p for p in (copy / "blobs").rglob("*") if p.is_file() and match.recording.endswith(p.name)]
    blob.write_bytes(blob.read_bytes()[:-1] + b"x")
    done = call("watch", str(match.id), "--save", "out.rrd", cwd=tmp_path)
    assert done.returncode == 2
    assert match.recording in done.stderr
    assert not (tmp_path / "out.rrd").exists()


def test_recordings_and_policies_are_open_to_python(tiny_league):
    folder, _ = tiny_league
    with league.open(str(folder / "league-data")) as opened:
        recorded = opened.recordings()
        assert set(recorded.match) == set(opened.matches().query("recorded").match)
        episode, swapped = opened.episodes(int(recorded.match.iloc[-1]))
        assert set(episode.positions) == set(episode.actions) == {"blue/0", "red/0"}
        steps = len(episode.time)
        assert {path.shape for path in episode.positions.values()} == {(steps, 3)}
        assert episode.rewards.shape == (steps, 2)
        assert swapped.header.sides == episode.header.sides[::-1]
        assert len(episode.events) == len(episode.recording.events)
        for name in ("blue", "pusher", "random"):
            policy = opened.policy(name)
            actions = policy(np.zeros((3, policy.observation_size)))
            assert actions.shape == (3, policy.action_size)
        payoff = opened.payoff(newest=True)
        assert payoff.scores.shape == payoff.games.shape
        assert opened.explain("blue").probability.sum() == pytest.approx(1.0)
        with pytest.raises(StorageError, match=r"^match and best ask for different matches: give one of them$"):
            opened.recording(1, best=True)
        with pytest.raises(StorageError, match="a recording is chosen by match, episode, best"):
            opened.recording(loudest=True)


def test_presets_are_listed_a_line_each_and_printed_in_full(capsys):
    from league.config import experiment, presets

    rows = json.loads(said(capsys, "presets", "--format", "json")[1])
    assert [row["preset"] for row in rows] == list(presets.PRESETS)
    assert all(row["what"].endswith(".") and "\n" not in row["what"] for row in rows)
    assert experiment.loads(said(capsys, "presets", "duel")[1]) == presets.preset("duel")
