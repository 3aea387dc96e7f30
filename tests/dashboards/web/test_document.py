"""The page as HTML: all that a name may hold stands in it as text, and nothing leads away from it."""

import base64
import hashlib

import pytest

from dashboards.tables import Column, render
from dashboards.web.document import (
    Card,
    FigureBlock,
    FilmBlock,
    Page,
    PairTable,
    Section,
    TableBlock,
    body,
    document,
    script,
)  # fmt: skip
from tests.markup import Markup

NASTY = "</script><script>alert(1)</script>&\"'<!--"
FIGURE = {"data": [{"type": "scatter", "x": [1], "y": [2], "name": NASTY}], "layout": {"height": 300}}
ROWS = TableBlock(
    render([{"name": NASTY, "elo": 1200.4}], [Column("name", no_wrap=True), Column("elo", decimals=0)], "html"), NASTY
)
PAIRS = PairTable([NASTY], ["b"], ["match"], {NASTY: {"b": [["1", NASTY]]}}, NASTY)
PAGE = Page(NASTY, NASTY, [Section("one", NASTY, [NASTY, FigureBlock(FIGURE, NASTY), ROWS, PAIRS])], "7")


@pytest.mark.parametrize("live", [False, True])
def test_whatever_a_name_holds_is_text(live):
    page = Markup(document(PAGE, live))
    assert page.headings == [("h1", NASTY), ("h2", NASTY)]
    assert page.figures == {"one-1": FIGURE}
    assert page.captions == {"one-1": NASTY}
    assert page.data == [{"heads": ["match"], "found": {NASTY: {"b": [["1", NASTY]]}}, "led": ""}]
    assert page.tables[""] == [["name", "elo"], [NASTY, "1200"]]
    assert len(page.scripts) == 2  # Plotly's and its own
    assert len(page.ids) == len(set(page.ids))


def test_a_file_needs_nothing_else_and_its_policy_lets_it_fetch_nothing():
    page = Markup(document(PAGE))
    assert {link.partition(":")[0] for link in page.links} == {"#one", "#content", "data"}
    assert page.policy.startswith("default-src 'none'; script-src 'sha256-")
    assert page.scripts == [script("plotly.js"), script("page.js")]
    for text in page.scripts:
        assert base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() in page.policy


def test_a_served_page_asks_its_own_server_for_scripts_and_tells_its_state():
    page = Markup(document(PAGE, live=True))
    assert {"plotly.js", "page.js"} < set(page.links)
    assert page.attributes["body"]["data-live"] == "yes"
    assert page.attributes["content"]["data-version"] == "7"
    assert page.attributes["state"]["role"] == "status"


def test_a_figure_is_told_in_words():
    page = Markup(document(PAGE))
    assert page.labels == {"one-1": "one-1-told"}
    assert "one-1-told" in page.ids


def test_a_table_can_be_read_and_scrolled_without_a_mouse():
    page = Markup(document(PAGE))
    assert page.attributes["html"] == {"lang": "en"}
    assert [cell["scope"] for cell in page.header_cells] == ["col", "col", "row"]
    assert page.attributes["one-2"]["tabindex"] == "0"
    assert page.attributes["one-2"]["aria-label"] == NASTY
    assert page.attributes["one"]["aria-labelledby"] in page.ids


def test_cards_and_films_hold_any_text_and_stand_in_two_columns(tmp_path):
    (tmp_path / "film.webm").write_bytes(b"moving")
    film = FilmBlock.embedded(tmp_path / "film.webm", NASTY)
    card = Card(NASTY, NASTY, [NASTY], [("one", NASTY)], is_trouble=True)
    section = Section("one", "One", [card], [film, FilmBlock("no film")], tab="Tab")
    text = document(Page("Cup", "", [section]))
    page = Markup(text)
    assert page.headings == [("h1", "Cup"), ("h2", "One"), ("h3", NASTY)]
    assert page.captions == {"one-1": NASTY, "one-2": "no film"}
    assert page.notes.count(NASTY) == 1  # the answer
    assert "data:video/webm;base64,bW92aW5n" in page.links
    assert "media-src data:" in page.policy
    assert text.count("<video") == 1  # none for the film that is not there
    assert page.attributes["one-0"]["class"] == "card trouble"
    assert ">Tab</a>" in text


def test_what_plotly_cannot_read_is_refused():
    figure = {"data": [{"y": [float("nan")]}], "layout": {"height": 1}}
    with pytest.raises(ValueError, match="JSON"):
        body([Section("one", "One", [FigureBlock(figure, "")])])
