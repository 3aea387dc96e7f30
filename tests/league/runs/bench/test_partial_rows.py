"""Rows of an entry that is being played: what a run leaves, the next one finds; another entry's are refused."""

import json

import pytest

from league.runs.bench.entry_file import EntryError
from league.runs.bench.partial_rows import PartialRows

ENTRY = {"task": "t", "seed": 1, "policy e1": "0123456789abcdef0"}


@pytest.fixture
def left(tmp_path):
    """A file with the rows of two batches."""
    rows = PartialRows(tmp_path / "x.json.part", ENTRY)
    rows.add({"a": "e1", "b": "idle", "seed": 5, "results": [1, 2, 3]})
    rows.add({"a": "e1", "b": "idle", "seed": 6, "results": [3, 2, 1]})
    return tmp_path / "x.json.part"


def test_the_next_run_finds_them_and_adds_its_own(left):
    again = PartialRows(left, ENTRY)
    assert again.find(a="e1", b="idle", seed=6) == {"a": "e1", "b": "idle", "seed": 6, "results": [3, 2, 1]}
    assert again.find(a="e1", b="idle", seed=7) is None
    again.add({"a": "e1", "b": "idle", "seed": 7, "results": [0, 0, 6]})
    assert [row["seed"] for row in json.loads(left.read_text())["rows"]] == [5, 6, 7]


def test_the_seconds_of_both_runs_count(left):
    content = json.loads(left.read_text())
    left.write_text(json.dumps({**content, "seconds": 100.0}))
    assert PartialRows(left, ENTRY).seconds >= 100.0


def test_without_a_file_rows_are_kept_in_memory():
    rows = PartialRows(None, ENTRY)
    row = rows.add({"a": "e1"})
    assert rows.find(a="e1") is row


@pytest.mark.parametrize(
    ("now", "why"),
    [
        ({**ENTRY, "seed": 2}, r"x\.json\.part has games of an entry with another seed \(1, now 2\)"),
        ({**ENTRY, "policy e1": "f"}, r"another policy e1 \(0123456789abcdef, now f\)"),
        ({**ENTRY, "policy e2": "f"}, r"another policy e2 \(none, now f\)"),
    ],
)
def test_rows_of_another_entry_are_refused(left, now, why):
    with pytest.raises(EntryError, match=why) as refused:
        PartialRows(left, now)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"entry": {}, "rows": [1], "seconds": 1}', '{"entry": 1, "rows": [], "seconds": 1}']
)
def test_a_damaged_file_is_refused(left, text):
    left.write_text(text)
    with pytest.raises(EntryError, match="is damaged: remove it"):
        PartialRows(left, ENTRY)
