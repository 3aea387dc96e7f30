"""Frozen policies as files: what is written is all that the store knows, and what is read is examined."""

import hashlib
import json
import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import load_file

from agents.policy.networks import Actor
from agents.settings import Architecture
from league.commands import cli
from league.config import experiment as configuration
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.scheduling.match_scheduler import next_matches
from league.scheduling.progress_metrics import reference_opponents
from league.snapshots import policy_file
from league.snapshots.codec import freeze
from league.state.jobs import RatingMatch
from league.state.league_state import LeagueState
from storage.blobs import arrays
from storage.records import ArenaKey, Job, League, Match, PairCounts, Player, Snapshot
from storage.store import Store
from tests.league.conftest import ROOT

ROSTER = "chooser:1:3"
KEY = ArenaKey("rock-paper-scissors", "c0ffee00", "none")
CONFIG = configuration.default("rock-paper-scissors")
CONFIG = replace(CONFIG, rating=replace(CONFIG.rating, worlds=16, pairings=2, episodes_per_pair=8))


def actor(seed: int, **architecture) -> bytes:
    """A fresh policy for one agent of that roster, as a snapshot's bytes."""
    torch.manual_seed(seed)
    made = Actor(1, 3, Architecture(**architecture), 0.8)
    return freeze([{name: tensor.numpy() for name, tensor in made.state_dict().items()}])


def match(a: str, b: str, wins: int, draws: int, losses: int) -> Match:
    return Match("home", KEY, a, b, wins, draws, losses, 1, 0, 0, 0, PairCounts(), seed=1, voids_a=1)


def league_at(folder: Path, name: str, roster: str = ROSTER) -> Store:
    """A league with two players that were frozen twice, a script, and no matches."""
    store = Store.open(folder, create=True)
    config = configuration.dumps(replace(CONFIG, league=name))
    store.create_league(League(name, config))
    store.start_run(name, config, "here", {"robot-league": "0.1.0", "torch": "2.13.0"})
    store.add_players([Player(name, player, team, "main", roster) for team, player in enumerate(("blue", "red"))])
    put = store.blobs.put
    store.add_snapshots([
        Snapshot(
            name, f"{player}@{at}", put(actor(at, hidden=(8, 4), activation="elu", layer_norm=at > 0)), roster, player,
            parent=f"{player}@0" if at else None, initial=not at, arena=KEY, settings=config, step=1000 * at,
            iteration=at, seconds=75.0 * at,
        )
        for player in ("blue", "red") for at in (0, 4)
    ])  # fmt: skip
    store.add_snapshots([Snapshot(name, "rocky", put(b"rocky"), roster, script="rocky", origin="scripted")])
    return store


@pytest.fixture
def home(tmp_path):
    """A league that has played."""
    with league_at(tmp_path / "home", "home") as store:
        store.queue([Job("home", "any", "played")])
        claimed = store.claim("home", ["any"], "x", 60)
        assert claimed is not None
        store.finish(claimed[0], matches=[
            match("blue@4", "blue@0", 30, 4, 6), match("blue@4", "rocky", 20, 0, 20),
            match("red@4", "blue@4", 10, 10, 20),
        ])  # fmt: skip
        yield store


@pytest.fixture
def file(home, tmp_path, capsys) -> Path:
    """Its best policy, exported."""
    path = tmp_path / "best.safetensors"
    ran(capsys, "export", "blue@4", "-o", str(path), "--store", str(tmp_path / "home"))
    return path


def ran(capsys, *args: str, code: int = 0) -> str:
    """Run a command here; what it printed, or the one line by which it refuses."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(args))
    out, err = capsys.readouterr()
    assert (ended.value.code or 0) == code, err
    if code:
        assert out == ""
        assert err.startswith("league: ")
        assert err.count("\n") == 1
        assert len(err) < 600
    return err if code else out


def test_a_file_holds_the_networks_parameters_and_all_that_is_known(home, file, tmp_path, capsys):
    snapshot = next(s for s in home.snapshots("home") if s.name == "blue@4")
    kept = arrays.from_bytes(home.blobs.get(snapshot.digest))
    found = load_file(file)
    names = Actor(1, 3, Architecture((8, 4), "elu", True), 0.8).state_dict()
    assert found.keys() == kept.keys() == {f"0/{name}" for name in names}
    assert all((found[name] == kept[name]).all() and found[name].dtype == kept[name].dtype for name in kept)
    with safe_open(file, "np") as opened:
        told = json.loads(opened.metadata()["robot_league"])
    rating = Open(home, "home").ratings().set_index("name").loc["blue@4"]
    assert told.pop("rating") == {
        **KEY._asdict(), "episodes": int(rating.games), "elo": rating.elo, "low": rating.low, "high": rating.high,
        "known": bool(rating.known), "score": rating.win_rate,
    }  # fmt: skip
    assert told == {
        "format": 1, "league": "home", "name": "blue@4", "digest": snapshot.digest, "player": "blue",
        "origin": "trained", "roster": ROSTER, "arena": KEY._asdict(), "settings": snapshot.settings,
        "parents": ["blue@0"], "iteration": 4, "steps": 4000, "seconds": 300.0,
        "versions": {"robot-league": "0.1.0", "torch": "2.13.0"}, "created": snapshot.created,
        "agents": [{
            "kind": "chooser", "observation": 1, "action": 3, "hidden": [8, 4], "activation": "elu", "layer_norm": True,
            "state_std": False, "squash": None,
        }],
    }  # fmt: skip
    ran(capsys, "export", "blue@4", "--output", str(tmp_path / "again"), "--store", str(tmp_path / "home"))
    assert (tmp_path / "again").read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    "kind",
    [
        {"squash": 2.0}, {"state_std": True}, {"squash": 0.5, "state_std": True}, {"recurrent": 4},
        {"recurrent": 3, "layer_norm": True, "state_std": True},
    ],
)  # fmt: skip
def test_every_kind_of_policy_is_told_and_comes_back(kind, home, tmp_path, capsys):
    data = actor(5, hidden=(8,), **kind)
    home.add_snapshots([Snapshot("home", "blue@9", home.blobs.put(data), ROSTER, "blue", iteration=9, arena=KEY)])
    path = tmp_path / "nine.safetensors"
    ran(capsys, "export", "blue@9", "-o", str(path), "--store", str(tmp_path / "home"))
    policy = policy_file.read(path)
    assert policy.about["agents"][0].items() >= {"squash": None, "state_std": False, **kind}.items()
    assert arrays.to_bytes(policy.arrays) == data
    card = path.with_name("nine.safetensors.md").read_text()
    assert ("squashed to ±" in card, "deviation by state" in card) == ("squash" in kind, "state_std" in kind)
    assert (f"then a GRU of {kind.get('recurrent')} units" in card) == ("recurrent" in kind)


def test_the_card_tells_what_the_store_knows(file):
    card = file.with_name("best.safetensors.md").read_text()
    for line in (
        "# blue@4 of league home",
        "| agent 0 | chooser: sees 1 numbers, acts with 3; hidden layers 8, 4, elu with LayerNorm |",
        "| trained | 4 iterations, 4,000 steps (decisions × worlds), 5:00 |",
        "| goes on from | blue@0 |",
        "| versions | robot-league 0.1.0, torch 2.13.0 |",
        "after 120 episodes; the mean of the initial snapshots is 1000. Void: 1.6 % by its own robots",
        "| rocky (script) | 50.0 % (35.2-64.8) of 40 |",
        "| blue@0 (initial) | 80.0 % (",
    ):
        assert line in card, card
    assert "red@4" not in card


def test_a_card_of_what_never_played_says_so(home, tmp_path, capsys):
    where = ("--store", str(tmp_path / "home"))
    ran(capsys, "export", "red@0", "-o", str(tmp_path / "r"), "--card", str(tmp_path / "card.txt"), *where)
    assert "It has played no rating match." in (tmp_path / "card.txt").read_text()
    assert not (tmp_path / "r.md").exists()
    assert policy_file.read(tmp_path / "r").about["rating"] is None


def test_an_imported_policy_is_an_opponent_of_the_league_at_once(file, tmp_path, capsys):
    where = ("--store", str(tmp_path / "away"))
    with league_at(tmp_path / "away", "away") as store:
        before = store.revision("away")
        said = ran(capsys, "import", str(file), "--as", "anchor", *where)
        assert "anchor of league away is home/blue@4 (chooser:1:3)." in said
        assert store.revision("away") > before  # whoever manages it looks again
        found = next(s for s in store.snapshots("away") if s.name == "anchor")
        assert (found.origin, found.player, found.script, found.initial) == ("imported", None, None, False)
        assert (found.iteration, found.step, found.seconds, found.arena) == (4, 4000, 300.0, KEY)
        assert found.digest == next(s.digest for s in store.snapshots("away") if s.name == "blue@4")  # the same bytes
        assert "anchor" in ran(capsys, "ratings", *where)

        plan = next_matches(replace(CONFIG, league="away"), LeagueState.of(store, "away"))
        pairs = {pair for job in plan.jobs for pair in job.payload["pairs"]}
        assert pairs
        state = LeagueState.of(store, "away")
        newest = next(s for s in state.snapshots if s.name == "red@4")
        assert "anchor" in [s.name for s in reference_opponents(CONFIG, state, newest)]

        again = ran(capsys, "import", str(file), "--as", "anchor", *where)
        assert again == said
        assert sum(s.origin == "imported" for s in store.snapshots("away")) == 1


def test_an_imported_policy_plays_and_is_rated(file, tmp_path, capsys):

    where = ("--store", str(tmp_path / "away"))
    with league_at(tmp_path / "away", "away") as store:
        ran(capsys, "import", str(file), "--as", "anchor", *where)
        evaluator = MatchEvaluator(CONFIG, CONFIG.arena.build(engine="c", threads=1), "away")
        played = evaluator.play(store, RatingMatch((("anchor", "red@0"), ("blue@4", "anchor")), 5))
        assert [m.wins + m.draws + m.losses for m in played] == [8, 8]
        store.queue([Job("away", "any", "played")])
        claimed = store.claim("away", ["any"], "x", 60)
        assert claimed is not None
        store.finish(claimed[0], matches=played)
        rows = Open(store, "away").ratings().set_index("name")
        assert rows.loc["anchor"].games == 16
        assert np.isfinite(rows.loc["anchor"].elo)


@pytest.mark.parametrize("name", policy_file.trained())
def test_what_comes_with_the_league_fits_the_arena_that_it_learnt_in(name, tmp_path, capsys):
    policy = policy_file.read(policy_file.find(name))
    settings = configuration.loads(policy.about["settings"])
    assert settings.arena.name == policy.about["arena"]["arena"]
    sides = settings.arena.outline().teams.values()
    rosters = ["+".join(f"{seat.kind}:{seat.observation_size}:{seat.action_size}" for seat in side) for side in sides]
    (roster,) = {*rosters} & {policy.about["roster"]}
    league_at(tmp_path / "away", "away", roster).close()
    said = ran(capsys, "import", name, "--as", "strong", "--store", str(tmp_path / "away"))
    assert said.startswith("strong of league away is ")
    assert roster in said
    assert (policy_file.TRAINED / f"{name}.safetensors.md").read_text().startswith("# ")


def test_an_unknown_trained_policy_is_refused_with_those_that_there_are(tmp_path, capsys):
    league_at(tmp_path / "away", "away", ROSTER).close()
    told = ran(capsys, "import", "anymal-wal", "--as", "x", "--store", str(tmp_path / "away"), code=2)
    assert "There is no file or trained policy 'anymal-wal' here" in told
    assert "Did you mean 'anymal-walk'?" in told


def test_a_policy_of_another_roster_is_refused_with_both(file, tmp_path, capsys):
    league_at(tmp_path / "away", "away", "rover:20:2+rover:20:2").close()
    told = ran(capsys, "import", str(file), "--as", "x", "--store", str(tmp_path / "away"), code=2)
    assert "The policy is for chooser:1:3, and league 'away' in rock-paper-scissors has rover:20:2+rover:20:2" in told


def test_bad_asks_get_one_line(file, tmp_path, capsys):
    where = ("--store", str(tmp_path / "home"))
    os.mkfifo(tmp_path / "pipe")
    out = ("-o", str(tmp_path / "x"))
    for args, says in (
        (("export", *where), "league export needs SNAPSHOT"),
        (("export", "blue@4", *where), "league export needs -o FILE"),
        (("export", "blue@5", *out, *where), "There is no snapshot 'blue@5' here"),
        (("export", "rocky", *out, *where), "rocky is a script"),
        (("export", "blue@4", "-o", str(file), *where), "exists already"),
        (("export", "blue@4", "-o", str(tmp_path), *where), "is a folder"),
        (("export", "blue@4", *out, "--card", str(tmp_path / "x"), *where), "is the file itself"),
        (("export", "blue@4", *out, "--league", "hone", *where), "There is no league 'hone' here; there is: home."),
        (("export", "blue@4", *out, "--store", str(tmp_path / "none")), "No league store"),
        (("import", *where), "league import needs FILE"),
        (("import", str(file), *where), "league import needs --as NAME"),
        (("import", str(file), "--as", "a b", *where), "a name is made of letters"),
        (("import", str(file), "--as", "x.safetensors", *where), "a name does not end in .safetensors"),
        (("import", str(file), "--as", "blue", *where), "has a player or snapshot of that name"),
        (("import", str(file), "--as", "rocky", *where), "has a player or snapshot of that name"),
        (("import", str(file), "--as", "x", "--league", "hone", *where), "There is no league 'hone' here"),
        (("import", str(file), "--as", "x", "--store", str(tmp_path / "none")), "No league store"),
        (("import", str(tmp_path / "pipe"), "--as", "x", *where), "is no file"),
        (("import", str(tmp_path), "--as", "x", *where), "is no file"),
        (("import", str(tmp_path / "none"), "--as", "x", *where), "No such file"),
    ):  # fmt: skip
        assert says in ran(capsys, *args, code=2)
    assert not (tmp_path / "x").exists()
    assert not (tmp_path / "x.md").exists()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


# Hostile files -------------------------------------------------------------------------------------------------------


def rewritten(path: Path, arrays_too=None, **told) -> None:
    """Write a file anew with other metadata and other arrays."""
    policy = policy_file.read(path)
    found = {name: np.array(array) for name, array in policy.arrays.items()}
    if arrays_too is not None:
        found = arrays_too(found) or found
    about = {**policy.about, **told}
    if "digest" not in told:
        about["digest"] = hashlib.sha256(arrays.to_bytes(found)).hexdigest()
    path.write_bytes(policy_file.Policy(found, about).to_bytes())


def header(path: Path, change) -> None:
    """Change the text of a file's header."""
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    text = change(data[8 : 8 + size])
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)


def without(name: str):
    return lambda found: {key: array for key, array in found.items() if key != name}


def put(name: str, value: float):
    def change(found):
        found[name].flat[0] = value

    return change


HOSTILE = {
    "empty": (lambda p: p.write_bytes(b""), "is no policy"),
    "text": (lambda p: p.write_text("hello" * 99), "is no policy"),
    "pickle": (lambda p: torch.save({"x": torch.ones(1)}, p), "is no policy"),
    "cut off": (lambda p: p.write_bytes(p.read_bytes()[:-1]), "is no policy"),
    "longer": (lambda p: p.write_bytes(p.read_bytes() + b"x"), "is no policy"),
    "huge header": (lambda p: p.write_bytes(struct.pack("<Q", 2**60) + b"{}"), "is no policy"),
    "deep header": (lambda p: header(p, lambda text: b"[" * 100_000), "is no policy"),
    "no metadata": (lambda p: p.write_bytes(arrays.to_bytes(policy_file.read(p).arrays)), "was not written by"),
    "other metadata": (lambda p: header(p, lambda t: t.replace(b"robot_league", b"robot-league")), "was not written"),
    "newer": (lambda p: rewritten(p, format=7), "has format 7, but this program knows only up to 1"),
    "no format": (lambda p: rewritten(p, format=None), "its format is no number"),
    "flipped": (flipped, "are not those that were exported"),
    "digest": (lambda p: rewritten(p, digest="0" * 64), "are not those that were exported"),
    "roster": (lambda p: rewritten(p, roster="chooser:2:3"), "and chooser needs (2,)"),
    "two agents": (lambda p: rewritten(p, roster=f"{ROSTER}+{ROSTER}"), "agent 1 has no parameter"),
    "no roster": (lambda p: rewritten(p, roster="chooser"), "is no agent's kind"),
    "large roster": (lambda p: rewritten(p, roster="chooser:1:" + "9" * 4000), "no agent's kind"),
    "long name": (lambda p: rewritten(p, name="x" * 10_000), "its name is no text"),
    "roster a list": (lambda p: rewritten(p, roster=[ROSTER]), "its roster is no text"),
    "name": (lambda p: rewritten(p, name="\x1b[2J"), "its name is no text"),
    "settings": (lambda p: rewritten(p, settings="a\0b"), "its settings is no text"),
    "steps": (lambda p: rewritten(p, steps=-1), "its steps are no number"),
    "many steps": (lambda p: rewritten(p, steps=2**63), "its steps are no number"),
    "seconds": (lambda p: rewritten(p, seconds="1"), "its seconds are no number"),
    "arena": (lambda p: rewritten(p, arena={"arena": "x"}), "its arena is not given"),
    "arena of lists": (lambda p: rewritten(p, arena={**KEY._asdict(), "engine": ["c"]}), "its arena is not given"),
    "missing": (lambda p: rewritten(p, without("0/mean.bias")), "has no parameter mean.bias"),
    "unknown": (lambda p: rewritten(p, lambda f: f | {"0/x": f["0/mean.bias"]}), "an unknown parameter x"),
    "of nobody": (lambda p: rewritten(p, lambda f: f | {"7/x": f["0/mean.bias"]}), "is a parameter of no agent"),
    "not finite": (lambda p: rewritten(p, put("0/mean.weight", np.nan)), "mean.weight is not finite"),
    "activation": (lambda p: rewritten(p, put("0/activation", 9)), "has activation 9"),
    "halves": (lambda p: rewritten(p, lambda f: f | {"0/mean.bias": f["0/mean.bias"].astype("f2")}), "of type float16"),
    "shape": (lambda p: rewritten(p, lambda f: f | {"0/mean.bias": np.ones(4, "f4")}), "has the shape (4,)"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_file_that_is_no_policy_is_refused_in_one_line(case, file, home, tmp_path, capsys):
    spoil, says = HOSTILE[case]
    spoil(file)
    before = home.snapshots("home")
    assert says in ran(capsys, "import", str(file), "--as", "x", "--store", str(tmp_path / "home"), code=2)
    assert home.snapshots("home") == before


def test_nothing_heavy_is_loaded(file, tmp_path):
    script = (
        "import sys; from league.commands.store import policies; "
        f"policies.import_([{str(file)!r}, '--as', 'x', '--store', {str(tmp_path / 'home')!r}]); "
        f"policies.export(['x', '-o', {str(tmp_path / 'y')!r}, '--store', {str(tmp_path / 'home')!r}]); "
        "print([m for m in ('jax', 'torch', 'mujoco', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr
    assert policy_file.read(tmp_path / "y").about["origin"] == "imported"
