import csv
import io
import json

import pytest

from dashboards.tables import Column, render
from dashboards.untrusted_text import csv_cell, encodable, json_escape, visible, visible_lines
from dashboards.web.document import Page, Section, document

HOSTILE = {
    "an escape sequence": "blue\x1b[2J", "the same in one byte": "blue\x9b2J", "a bell": "blue\x07",
    "a line turned round": "blue\u202e61@", "a line end": "blue\nred", "a carriage return": "blue\rred",
    "a character of no width": "bl\u200bue", "half a character": "blue\udcff", "no character": "\U000e0001blue",
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize("format", ["table", "csv", "json", "html"])
def test_every_character_of_a_foreign_name_is_visible_in_every_format(name, format):
    text = render([{"name": name, name: 1}], (), format, title=f"of {name}")
    assert all(line.isprintable() for line in text.split("\n"))
    if format == "json":
        assert json.loads(text)[0]["name"] == name
        assert text.isascii()
    else:
        assert visible(name) in text


@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
def test_a_page_shows_every_character_of_a_foreign_name(name):
    text = document(Page(f"of {name}", name, (Section("a", name, (f"notes on {name}",)),), "1"))
    marks = set(name) - {"\n"}
    assert not any(not c.isprintable() and c in text for c in marks)


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1+1", "@SUM(A1)", " =1", "\t=1", "\r@x"])
def test_a_spreadsheet_evaluates_no_cell(text):
    line = render([{"name": text, "elo": -3.5}], (), "csv").splitlines()[1]
    name, elo = next(csv.reader(io.StringIO(line)))
    assert name == csv_cell(text)
    assert name[0] in "'\\"
    assert elo == "-3.5"


@pytest.mark.parametrize("name", ["blue@16", "a=b", "Łódź", "東京", "a-b", "½"])
def test_ordinary_names_are_printed_as_they_are(name):
    assert visible(name) == csv_cell(name) == name
    assert name in render([{"name": name}], [Column("name")], "table")


@pytest.mark.parametrize("character", ["\x1b", "\u202e", "\U000e0001", "\udcff"])
def test_an_escape_is_one_that_json_knows(character):
    assert json.loads(f'"{json_escape(character)}"') == character


def test_an_encoding_that_lacks_the_marks_of_tables_gets_others():
    assert encodable("── ± ×½ 東", "latin-1") == "-- ± ×½ \\u6771"
    assert encodable("── ± ×½ 東", "ascii") == "-- +- x1/2 \\u6771"
    assert encodable("── 東", "utf-8") == "── 東"


def test_lines_stay_lines():
    assert visible_lines("a\nb\x1b\n") == "a\nb\\u001b\n"
