import csv
import io
import json
import random
import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from dashboards import tables
from dashboards.tables import Column, render

ROWS = [
    {"player": "blue@16", "rating": 1523.456789, "score": 0.75, "games": 12800, "live": True},
    {"player": "[red]@8 ✓", "rating": -37.1, "score": 1 / 3, "games": 64, "live": False},
    {"player": "script:pusher", "rating": None, "score": float("nan"), "games": 0, "live": False},
]
COLUMNS = [
    Column("player", "Player"),
    Column("rating", "Elo", 1),
    Column("score", "Score"),
    Column("games", "Games"),
    "live",
]


def test_what_rounds_to_zero_has_no_minus():
    assert render([{"elo": -0.3}, {"elo": -41.0}], [Column("elo", decimals=0)]).split()[-2:] == ["0", "-41"]


def test_table_lines_up_numbers_and_leaves_markup_alone():
    assert render(ROWS, COLUMNS, title="Ratings of demo", width=80).splitlines() == [
        "Ratings of demo",
        "",
        " Player             Elo   Score    Games   live",
        " ──────────────────────────────────────────────",
        " blue@16         1523.5   0.750   12,800   yes",
        " [red]@8 ✓        -37.1   0.333       64   no",
        " script:pusher        –       –        0   no",
    ]


def test_table_without_a_terminal_is_plain_text_of_at_most_80_columns():
    program = (
        "from dashboards.tables import render\n"
        "print(render([{'name': 'x' * 200, 'note': 'a few words ' * 20, 'games': 123456789, 'elo': -1500.25}]))"
    )
    text = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 80
    assert "123,456,789" in text
    assert "-1,500" not in text  # grouped per column
    assert "-1500" in text
    assert text.count("x") == 200  # folded, not cut


def test_no_number_is_cut_where_the_table_is_too_wide():
    row = {"player": "blue-2", **{f"figure_{i}": 1234567.25 + i for i in range(12)}, "note": "words " * 9}
    for width in (30, 60, 80, 120):
        text = render([row], [*row], width=width)
        assert max(map(len, text.splitlines())) <= width
        shown = [f"figure_{i}" for i in range(12) if f"{1234567 + i:,}" in text]
        assert shown == [f"figure_{i}" for i in range(len(shown))]
        (told,) = re.findall(r"too few for: ([^─]*)", " ".join(text.split()))
        assert told.split(", ") == [name for name in row if name not in ("player", *shown)]
    assert "too few" not in render([row], [*row], width=300)


@pytest.mark.parametrize(
    ("values", "texts"),
    [([0.5, 0.1234], ["0.500", "0.123"]), ([1.5, 0.1], ["1.50", "0.10"]), ([12.345, 0.5], ["12.3", "0.5"])],
)
def test_decimals_follow_the_largest_value_of_the_column(values, texts):
    lines = render([{"x": value} for value in values]).splitlines()
    assert [line.strip() for line in lines[-2:]] == texts


def test_json_keeps_every_digit_and_has_null_for_what_is_missing():
    read = json.loads(render(ROWS, COLUMNS, format="json"))
    assert list(read[0]) == ["player", "rating", "score", "games", "live"]
    assert read[0] == ROWS[0]
    assert read[1]["score"] == 1 / 3
    assert (read[2]["rating"], read[2]["score"]) == (None, None)


def test_csv_keeps_every_digit_and_quotes_what_it_must():
    text = render([{"name": 'a "b", c', "x": 1 / 3, "y": None}], format="csv")
    assert text == f'name,x,y\n"a ""b"", c",{1 / 3!r},'
    assert list(csv.DictReader(io.StringIO(text))) == [{"name": 'a "b", c', "x": repr(1 / 3), "y": ""}]


def test_data_frames_give_the_same_as_rows():
    frame = pd.DataFrame(ROWS)
    for format in ("table", "json", "csv"):
        rows = [row | {"score": None} if row["player"].startswith("script") else row for row in ROWS]
        assert render(frame, COLUMNS, format=format) == render(rows, COLUMNS, format=format)


def test_a_named_index_is_a_column_and_an_unnamed_one_is_not():
    frame = pd.DataFrame({"wins": np.array([3, 4])}, index=pd.Index(["blue", "red"], name="team"))
    assert json.loads(render(frame, format="json")) == [{"team": "blue", "wins": 3}, {"team": "red", "wins": 4}]
    assert json.loads(render(frame.reset_index(drop=True), format="json")) == [{"wins": 3}, {"wins": 4}]


def test_no_rows_are_said_in_each_format():
    assert render([], ["player"], title="Ratings").splitlines()[0] == "Ratings"
    assert render([], ["player"]).splitlines()[-1] == "(none)"
    assert render([], ["player"], format="json") == "[]"
    assert render([], ["player"], format="csv") == "player"


def test_html_has_a_tables_cells_and_names_rows_and_columns():
    text = render(
        [{"name": "<a>", "games": 12800, "elo": None}], [Column("name", no_wrap=True), "games", "elo"], "html", "T"
    )
    assert text == (
        '<table><caption>T</caption><thead><tr><th scope="col" class="whole">name</th>'
        '<th scope="col" class="number">games</th>'
        '<th scope="col">elo</th></tr></thead>\n<tbody>\n'
        '<tr><th scope="row">&lt;a&gt;</th><td class="number">12,800</td><td>–</td></tr>\n</tbody></table>'
    )
    assert '<td colspan="2">(none)</td>' in render([], ["a", "b"], "html")


def test_html_has_a_button_for_a_command_and_nothing_where_there_is_none():
    text = render([{"type": "ls > x"}, {"type": None}], [Column("type", is_command=True)], "html")
    assert '<td><button type="button" class="copy">ls &gt; x</button></td>' in text
    assert "<td></td>" in text


def test_an_unknown_format_names_those_there_are():
    with pytest.raises(ValueError, match="no format 'xml'; choose one of: table, json, csv, html"):
        render(ROWS, format="xml")


def test_importing_it_loads_neither_pandas_nor_numpy():
    program = (
        "import sys, dashboards.tables; print([m for m in ('pandas', 'numpy', 'rich', 'rerun') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("seed", range(30))
def test_a_table_that_fits_looks_the_same_without_the_library_that_folds(seed, monkeypatch):
    rng = random.Random(seed)
    keys = ["alpha", "b", "c_long_title", "d"][: rng.randint(1, 4)]
    values = [None, 1, 2.5, "text é ×", True, 12345, -0.25, "x"]
    rows = [{key: rng.choice(values if key != "d" else [1, 20_000, None]) for key in keys} for _ in range(seed % 7)]
    columns, title = [Column(key, no_wrap=rng.random() < 0.5) for key in keys], rng.choice(["", "A title"])
    assert tables._is_plain(keys, [[str(row[key]) for row in rows] for key in keys], 80)
    plain = render(rows, columns, title=title, width=80)
    monkeypatch.setattr(tables, "_is_plain", lambda *_: False)
    assert render(rows, columns, title=title, width=80) == plain
