"""Reads a page as a browser's parser would, for tests of what stands in it."""

import json
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "link", "br", "img", "input"}


class Markup(HTMLParser):
    """What a page holds: headings, tables, figures, notes, ids, and every address that it names."""

    def __init__(self, text: str):
        super().__init__()
        self.headings: list[tuple[str, str]] = []  # tag and text
        self.tables: dict[str, list[list[str]]] = {}  # by caption: cells, the header first
        self.header_cells: list[dict[str, str | None]] = []  # attributes of every th
        self.figures: dict[str, Any] = {}  # by id: what Plotly gets
        self.labels: dict[str, str] = {}  # by id of the figure: the id of what a screen reader says
        self.captions: dict[str, str] = {}  # by id of the figure: what it says
        self.data: list[Any] = []  # what other parts of the page are given as JSON
        self.notes: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []  # every href and src
        self.scripts: list[str] = []  # that would be run
        self.attributes: dict[str, dict[str, str | None]] = {}  # of the elements with an id, and of body and html
        self.policy = ""
        self._open: list[str] = []
        self._text = ""
        self._figure = ""
        self._rows: list[list[str]] = []
        self._name = ""
        self._kind: str | None = None
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag not in VOID:
            self._open.append(tag)
        self.links += [value for key, value in attrs if key in ("href", "src")]
        if "id" in given:
            self.ids.append(given["id"])
            self.attributes[given["id"]] = given
        if tag in ("html", "body"):
            self.attributes[tag] = given
        match tag:
            case "meta" if given.get("http-equiv") == "Content-Security-Policy":
                self.policy = given["content"]
            case "figure":
                self._figure = given["id"]
            case "div" if given.get("role") == "img":
                self.labels[self._figure] = given["aria-labelledby"]
            case "table":
                self._rows, self._name = [], ""
            case "tr":
                self._rows.append([])
            case "th":
                self.header_cells.append(given)
            case "script":
                self._kind = given.get("type")
        self._text = ""

    def handle_data(self, data):
        self._text += data

    def handle_endtag(self, tag):
        assert self._open.pop() == tag
        match tag:
            case "h1" | "h2" | "h3":
                self.headings.append((tag, self._text))
            case "caption":
                self._name = self._text
            case "th" | "td":
                self._rows[-1].append(self._text)
            case "table":
                self.tables[self._name] = self._rows
            case "p":
                self.notes.append(self._text)
            case "figcaption":
                self.captions[self._figure] = self._text
            case "script" if self._kind == "application/json" and "figure" not in self._open:
                self.data.append(json.loads(self._text))
            case "script" if self._kind == "application/json":
                self.figures[self._figure] = json.loads(self._text)
            case "script":
                self.scripts.append(self._text)
        self._text = ""
