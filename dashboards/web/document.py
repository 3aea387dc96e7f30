"""A page of figures and tables in HTML, as one self-contained file or as a page that a server keeps up to date.

Neither makes requests to other hosts: Plotly's script comes from its Python package, and a content security policy
makes the browser refuse all other requests.
"""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from dashboards.errors import ViewerError
from dashboards.untrusted_text import visible_lines
from dashboards.web.figures import Figure


@dataclass(frozen=True)
class FigureBlock:
    """A figure and its caption, which also describes it to screen readers."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class TableBlock:
    """A table as `dashboards.tables.render` writes it in HTML, and its name."""

    markup: str
    name: str


@dataclass(frozen=True)
class PairTable:
    """A table that shows the rows of one pair, chosen in two lists or in the heat map before it.

    `found[a][b]` has the rows of a against b: each has as many texts as there are `heads`, the last one a command to
    copy. The first text of a row with a command links to `link_prefix` plus that text, if `link_prefix` is not empty.
    """

    firsts: Sequence[str]
    seconds: Sequence[str]
    heads: Sequence[str]
    found: Mapping[str, Mapping[str, Sequence[Sequence[str]]]]
    name: str
    link_prefix: str = ""


@dataclass(frozen=True)
class Card:
    """An answer in a few words, with the lines behind it, and links to sections: pairs of id and text."""

    title: str
    answer: str
    lines: Sequence[str] = ()
    links: Sequence[tuple[str, str]] = ()
    is_trouble: bool = False


@dataclass(frozen=True)
class FilmBlock:
    """A film by its address on the page's server or as a `data:` URI, and its caption.

    Without an address the caption says why there is none.
    """

    caption: str
    source: str = ""
    size: tuple[int, int] = (480, 300)  # pixels

    @classmethod
    def embedded(cls, path: Path, caption: str) -> "FilmBlock":
        """Return a WebM file as a film that needs no file."""
        return cls(caption, f"data:video/webm;base64,{base64.b64encode(path.read_bytes()).decode()}")


Part = str | FigureBlock | TableBlock | PairTable | Card | FilmBlock
"""A part of a section; a str is plain text."""


@dataclass(frozen=True)
class Section:
    """A part of the page under a heading: its parts in order, and those in a second column where there is room.

    `tab` is its name in the navigation, by default the title.
    """

    id: str
    title: str
    parts: Sequence[Part]
    aside: Sequence[Part] = ()
    tab: str = ""


@dataclass(frozen=True)
class Page:
    """The whole page. `version` identifies the state that it shows."""

    title: str
    about: str
    sections: Sequence[Section]
    version: str = ""


def document(page: Page, live: bool = False) -> str:
    """Return the page in HTML; a `live` page asks its server for scripts and for later states.

    Raises ViewerError where Plotly is not installed.
    """
    title, sections = _text(page.title), page.sections
    links = "".join(f'<li><a href="#{_text(s.id)}">{_text(s.tab or s.title)}</a></li>' for s in sections)
    own = script("page.js")
    if live:
        scripts = '<script src="plotly.js"></script>\n<script src="page.js" defer></script>'
        policy, last = "", ""
    else:
        scripts = f"<script>{script('plotly.js')}</script>"
        policy = f'<meta http-equiv="Content-Security-Policy" content="{_policy(script("plotly.js"), own)}">\n'
        last = f"\n<script>{own}</script>"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{policy}<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>
{_static("page.css")}</style>
{scripts}
</head>
<body{' data-live="yes"' if live else ""}>
<a class="skip" href="#content">To the content</a>
<header>
<h1>{title}</h1>
<p class="about">{_text(page.about)}</p>
</header>
<nav aria-label="Sections"><ul>{links}</ul></nav>
<main id="content" data-version="{_text(page.version)}">
{body(sections)}
</main>
<p id="state" role="status">{"Up to date." if live else ""}</p>{last}
</body>
</html>
"""


def body(sections: Sequence[Section]) -> str:
    """Return the part that changes with the league: the sections in order."""
    return "\n".join(map(_section, sections))


@cache
def script(name: str) -> str:
    """Return the text of a script that the page needs: `plotly.js` or `page.js`. Raises ViewerError without Plotly."""
    if name == "page.js":
        return _static(name)
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise missing_library("plotly", error) from error
    return get_plotlyjs()


def missing_library(library: str, error: ImportError) -> ViewerError:
    """Return the error for a library of the extra `dash` that is not installed."""
    need = f"the page of a league needs {library} ({error}); install it with: pip install 'robot-league[dash]'"
    return ViewerError(need)


def _policy(*scripts: str) -> str:
    """Return a policy by which the browser runs these scripts and no other, and fetches nothing."""
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; media-src data:"


def _static(name: str) -> str:
    return (resources.files("dashboards.web") / "static" / name).read_text("utf-8")


def _section(section: Section) -> str:
    name = _text(section.id)
    parts = [_part(f"{name}-{n}", part) for n, part in enumerate([*section.parts, *section.aside])]
    inside = "\n".join(parts)
    if section.aside:
        first = len(section.parts)
        columns = ("\n".join(parts[:first]), "\n".join(parts[first:]))
        inside = f'<div class="columns">\n<div>{columns[0]}</div>\n<div>{columns[1]}</div>\n</div>'
    head = f'<h2 id="{name}-title">{_text(section.title)}</h2>'
    return f'<section id="{name}" aria-labelledby="{name}-title">\n{head}\n{inside}\n</section>'


def _part(name: str, part: Part) -> str:
    match part:
        case str():
            return f'<p class="notes" id="{name}" data-block>{_text(part)}</p>'
        case TableBlock():
            return f'<div id="{name}" data-block {_region(part.name)}>{part.markup}</div>'
        case FigureBlock():
            return _picture(name, part)
        case PairTable():
            return _pairs(name, part)
        case Card():
            return _card(name, part)
        case FilmBlock():
            return film_markup(name, part)


def _region(name: str) -> str:
    """Return the attributes of an element that scrolls by itself."""
    return f'class="rows" role="region" tabindex="0" aria-label="{_text(name)}"'


def _card(name: str, part: Card) -> str:
    lines = "".join(f"<li>{_text(line)}</li>" for line in part.lines)
    links = " ".join(f'<a href="#{_text(id)}">{_text(text)}</a>' for id, text in part.links)
    return (
        f'<div class="card{" trouble" if part.is_trouble else ""}" id="{name}" data-block><h3>{_text(part.title)}</h3>'
        f'<p class="answer">{_text(part.answer)}</p>{f"<ul>{lines}</ul>" if lines else ""}'
        f"{f'<p>{links}</p>' if links else ''}</div>"
    )


def film_markup(name: str, part: FilmBlock) -> str:
    """Return a film that its reader starts and stops; it makes no sound, so nothing is lost by its captions' lack."""
    wide, high = part.size
    film = (
        f'<video src="{_text(part.source)}" width="{wide}" height="{high}" controls loop muted playsinline'
        f' preload="metadata" aria-labelledby="{name}-told"></video>'
        if part.source
        else ""
    )
    caption = f'<figcaption id="{name}-told">{_text(part.caption)}</figcaption>'
    return f'<figure class="film" id="{name}" data-block>{film}{caption}</figure>'


def _picture(name: str, part: FigureBlock) -> str:
    return (
        f'<figure class="chart" id="{name}" data-block><div class="plot" role="img" aria-labelledby="{name}-told"'
        f' style="height: {part.figure["layout"]["height"]}px"></div>'
        f'<figcaption id="{name}-told">{_text(part.caption)}</figcaption>{_embedded(part.figure)}</figure>'
    )


def _pairs(name: str, part: PairTable) -> str:
    lists = "".join(
        f'<label>{said} <select><option value="">choose</option>{_options(names)}</select></label>\n'
        for said, names in (("of", part.firsts), ("and", part.seconds))
    )
    return (
        f'<fieldset class="pairs" id="{name}" data-block><legend>{_text(part.name)}</legend>\n{lists}'
        f'<div {_region(part.name)} aria-live="polite" hidden></div>'
        f"{_embedded({'heads': part.heads, 'found': part.found, 'led': part.link_prefix})}</fieldset>"
    )


def _options(names: Sequence[str]) -> str:
    return "".join(f"<option>{_text(name)}</option>" for name in names)


def _embedded(value: Any) -> str:
    """Return a value as JSON that cannot end its script element. Raises ValueError for nan."""
    text = json.dumps(_visible(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    text = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return f'<script type="application/json">{text}</script>'


def _text(text: str) -> str:
    """Return text as HTML, without characters that reverse a line or hide the text before them."""
    return escape(visible_lines(text))


def _visible(value: Any) -> Any:
    """Return a JSON value with its texts as by `_text`, except for the escapes of HTML."""
    if isinstance(value, str):
        return visible_lines(value)
    if isinstance(value, Mapping):
        return {name: _visible(each) for name, each in value.items()}
    return [_visible(each) for each in value] if isinstance(value, list | tuple) else value
