"""Refusals in one line: settings that cannot be computed with, absurd sizes, names that are no files."""

import json
import struct
from pathlib import Path

import pytest

from league.snapshots.policy_file import KEY
from tests.faults.fuzz import answer, corpus
from tests.faults.hostile import FILES


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    corpus(folder)
    return folder


SETTINGS = {
    'arena = "sumo-1v1"': 'arena = "sumo-1v1": expected a table: its settings are keys such as arena.name',
    "arena = 3": "arena = 3: expected a table",
    "rating.pairings = 0": "rating.pairings = 0: must be between 1 and 4096",
    "arena.rules.timestep = 0.0": "arena.rules.timestep = 0.0: must be between",
    "learner.architecture.hidden = [" + "64, " * 20_000 + "]": "has 20,000 values; at most 32 are possible",
    f'league = "{"a" * 10_000_000}"': "has more than 10,000 characters",
    f'league = "{"a" * 101}"': "a name has at most 100 characters",
    "\ufefflearner.lr = -1.0": "learner.lr = -1.0: must be",
}


@pytest.mark.parametrize("text", SETTINGS, ids=lambda text: text[:40])
def test_settings_that_cannot_be(text: str, tmp_path: Path):
    (tmp_path / "league.toml").write_text(text, "utf-8")
    code, out, said = answer(("run", "league.toml", "--store", "new", "--help"), tmp_path)
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert SETTINGS[text] in said
    assert len(said) < 500


@pytest.mark.parametrize("name", [".", "", "..", "/", "a" * 300, "ä" * 200])
@pytest.mark.parametrize(
    "args",
    [
        ("pack", "{}"),
        ("export", "blue@1", "-o", "{}"),
        ("report", "-o", "{}"),
        ("export-match", "1", "--foxglove", "-o", "{}"),
    ],
    ids=lambda args: args[0],
)
def test_names_that_no_file_can_have(args: tuple[str, ...], name: str, kept: Path):
    before = sorted(kept.rglob("*"))
    code, _, said = answer((*(name if arg == "{}" else arg for arg in args), "--store", "store"), kept)
    assert (code, said.count("\n")) == (2, 1), said
    assert len(said) < 500
    assert sorted(kept.rglob("*")) == before


@pytest.mark.parametrize(
    "told", [None, [], 3, "x", {"format": 1}, {"arena": ["sumo"]}, {"arena": "sumo"}, {"league": {}}]
)
def test_a_policy_whose_header_is_of_other_types(told, kept: Path, tmp_path: Path):
    data = (kept / FILES["policy"]).read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    whole = json.loads(header["__metadata__"][KEY])
    header["__metadata__"] = {
        KEY: json.dumps({**whole, **told} if isinstance(told, dict) and told.keys() != {"format"} else told)
    }
    text = json.dumps(header).encode()
    (tmp_path / "x.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    code, _, said = answer(("import", "x.safetensors", "--as", "strange", "--store", str(kept / "store")), tmp_path)
    assert (code, said.count("\n")) == (2, 1)
    assert "x.safetensors is damaged" in said


OWN = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Settings:
    name: str = "nothing"

    def build(self, engine="auto", worlds=1, threads=None):
        return None

ARENAS = (Settings(),)
"""


@pytest.mark.parametrize(
    ("command", "code", "told"),
    [("check", 1, "returns None, which is no Arena"), ("arenas", 2, "league: arena own.py:nothing")],
)
def test_an_arena_whose_build_returns_nothing(command: str, code: int, told: str, tmp_path: Path):
    (tmp_path / "own.py").write_text(OWN)
    found, out, said = answer((command, "own.py:nothing"), tmp_path)
    assert found == code
    assert told in out + said
    assert (out + said).count("\n") == 1
