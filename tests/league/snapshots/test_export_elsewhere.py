"""The files of a policy that learnt elsewhere: they act as the league's matches have it act, not as it learnt."""

import hashlib
import re
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import arenas
from agents.policy.constant_inputs import is_constant
from league.config.experiment import Config, dumps
from league.queries.query import Open
from league.runtime.bootstrap import create
from league.snapshots import policy_file
from league.snapshots.policy_callable import policy_callable
from league.snapshots.transfer.arena_transfer import as_played
from storage.blobs import arrays
from storage.records import ArenaKey, League
from storage.store import Store
from tests.league.conftest import said

SCORE = policy_file.read(policy_file.find("anymal-score"))
ACTS = 12


@pytest.fixture(scope="module")
def pitch():
    return arenas.settings("soccer-1v1").build(engine="c", threads=1)


@pytest.fixture
def inside(tmp_path, monkeypatch, pitch) -> Path:
    """A folder with a league of soccer-1v1 into which a policy was imported that learnt to score alone."""
    monkeypatch.chdir(tmp_path)
    with Store.open("store", create=True) as store:
        create(store, Config(arena=arenas.settings("soccer-1v1")), pitch)
        policy_file.bring_in(Open(store, "main"), SCORE, "scorer")
    return tmp_path


def numpy_of(card: Path):
    """The function `act` of the lines of NumPy on a card."""
    lines = re.search(r"```python\n(.*?)```", card.read_text(), re.DOTALL)
    assert lines is not None
    names = {}
    exec(lines[1], names)
    return names["act"]


def test_its_files_act_as_in_the_matches_of_the_league(inside, capsys):
    code, out, err = said(capsys, "export", "scorer", "--onnx", "--torchscript", "-o", "x", "--store", "store")
    assert code == 0, err
    rng, rests = np.random.default_rng(0), is_constant(SCORE.arrays, "0/")
    mean, var = (SCORE.arrays[f"0/trunk.observation_{of}"] for of in ("mean", "var"))
    seen = (mean + np.sqrt(var) * rng.normal(size=(32, rests.size)) + 0.5 * rests).astype(np.float32)  # an enemy comes
    noise = np.zeros((32, ACTS), np.float32)
    with Open(Store.open("store"), "main") as opened:
        wanted = policy_callable(opened, "scorer")(seen)
    (onnx,) = onnxruntime.InferenceSession("x.onnx").run(None, {"observations": seen, "noise": noise})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        script = torch.jit.load("x.pt")(torch.tensor(seen), torch.tensor(noise)).numpy()
    card = Path("x.safetensors.md")
    for found in (np.asarray(onnx), script, numpy_of(card)(seen)):
        np.testing.assert_allclose(found, wanted, atol=1e-5)
    line = "It learnt in soccer-score, and league main plays soccer-1v1: as in the matches of league main, inputs"
    assert line in out
    assert line in card.read_text()
    raw = policy_file.read(Path("x.safetensors"))  # an import silences them again, where that is right
    assert raw.about["digest"] == SCORE.about["digest"]


def test_without_programs_the_lines_of_the_card_act_so_too(inside, capsys):
    assert said(capsys, "export", "scorer", "--onnx", "-o", "x", "--store", "store")[0] == 0
    assert said(capsys, "export", "scorer", "-o", "plain.safetensors", "--store", "store")[0] == 0
    seen = np.random.default_rng(1).normal(size=(8, 66)).astype(np.float32)
    np.testing.assert_array_equal(*(numpy_of(Path(f"{name}.safetensors.md"))(seen) for name in ("x", "plain")))


def test_under_the_rules_it_learnt_under_its_files_are_as_it_learnt(inside, pitch, capsys):
    key = ArenaKey("soccer-1v1", pitch.config_hash, "warp")
    home = policy_file.Policy(SCORE.arrays, {**SCORE.about, "arena": key._asdict()})
    with Open(Store.open("store"), "main") as opened:
        assert as_played(opened, home) == (home, False, "")
        policy_file.bring_in(opened, home, "local")
        told = as_played(opened, policy_file.Policy(SCORE.arrays, {**home.about, "arena": None}))
        assert (told.silenced, told.note) == (False, "")
        changed = {**home.about, "arena": key._replace(config_hash="c0ffee")._asdict()}
        note = as_played(opened, policy_file.Policy(SCORE.arrays, changed)).note
        assert note.startswith("It learnt in soccer-1v1, under other rules: as in the matches of league main")
    code, out, err = said(capsys, "export", "local", "--onnx", "-o", "y", "--store", "store")
    assert (code, out.count("\n")) == (0, 1), err
    page = Path("y.safetensors.md").read_text()
    assert "It learnt in" not in page
    assert "still" not in page


def test_where_the_arena_cannot_be_built_it_leaves_as_it_learnt_and_says_so(tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        config = dumps(Config(arena=arenas.settings("soccer-1v1")))
        store.create_league(League("main", config.replace('"soccer-1v1"', '"not/there.py:Arena"', 1)))
        found = as_played(Open(store, "main"), SCORE)
    assert found.policy is SCORE
    assert not found.silenced
    assert re.search(r"is not known: the league's arena cannot be built here \(.*not/there.py", found.note)


def test_a_player_of_two_agents_is_silenced_agent_by_agent(inside):
    """Also one that is a player's, whose rules have changed since."""
    both = {f"{i}/{k.partition('/')[2]}": array for i in range(2) for k, array in SCORE.arrays.items()}
    still = np.arange(66) == 3
    both["1/trunk.observation_var"] = np.where(still, 0.0, 1.0).astype(np.float32)
    agents = [*SCORE.about["agents"]] * 2
    about = {**SCORE.about, "agents": agents, "digest": hashlib.sha256(arrays.to_bytes(both)).hexdigest()}
    with Open(Store.open("store"), "main") as opened:
        found = as_played(opened, policy_file.Policy(both, about))
    assert found.silenced
    silent = found.policy.arrays
    for agent, rests in ((0, is_constant(SCORE.arrays, "0/")), (1, still)):
        weights, before = (each[f"{agent}/trunk.hidden.0.weight"] for each in (silent, both))
        assert not weights[:, rests].any()
        np.testing.assert_array_equal(weights[:, ~rests], before[:, ~rests])
