"""A page of figures and tables in HTML, as one file that needs nothing else, or as one that a server keeps up to date.

No request leaves either: Plotly's script comes from its Python package, and a content security policy has the browser
refuse all others.
"""

import base64
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from typing import Any

from dashboards.errors import ViewerError
from dashboards.figures import Figure


@dataclass(frozen=True)
class Picture:
    """A figure and what it shows, in words for those who see it and for those who do not."""

    figure: Figure
    told: str


@dataclass(frozen=True)
class Rows:
    """A table as `dashboards.tables.render` writes it in HTML, and its name."""

    markup: str
    name: str


@dataclass(frozen=True)
class Pairs:
    """A table of which a reader sees the rows of one pair, chosen in two lists or in the heat map that stands before.

    `found[a][b]` has the rows of a against b: each as many texts as there are `heads`, the last one a command to copy.
    The first of a row with a command leads to a page at `led` and that text, if `led` says something.
    """

    firsts: Sequence[str]
    seconds: Sequence[str]
    heads: Sequence[str]
    found: Mapping[str, Mapping[str, Sequence[Sequence[str]]]]
    name: str
    led: str = ""


@dataclass(frozen=True)
class Section:
    """A part of the page under a heading: notes (plain text), figures and tables, in their order."""

    id: str
    title: str
    parts: Sequence[str | Picture | Rows | Pairs]


@dataclass(frozen=True)
class Page:
    """All of it. `version` tells states of what it is about apart."""

    title: str
    about: str
    sections: Sequence[Section]
    version: str = ""


def document(page: Page, live: bool = False) -> str:
    """The page in HTML; a `live` one asks its server for scripts and for later states.

    Raises ViewerError where Plotly is not installed.
    """
    title, sections = escape(page.title), page.sections
    links = "".join(f'<li><a href="#{escape(s.id)}">{escape(s.title)}</a></li>' for s in sections)
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
<p class="about">{escape(page.about)}</p>
<nav aria-label="Sections"><ul>{links}</ul></nav>
</header>
<main id="content" data-version="{escape(page.version)}">
{body(sections)}
</main>
<p id="state" role="status">{"Up to date." if live else ""}</p>{last}
</body>
</html>
"""


def body(sections: Sequence[Section]) -> str:
    """What changes with the league: the sections, one after the other."""
    return "\n".join(map(_section, sections))


@cache
def script(name: str) -> str:
    """The text of a script that the page needs: `plotly.js` or `page.js`. Raises ViewerError without Plotly."""
    if name == "page.js":
        return _static(name)
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise missing("plotly", error) from error
    return get_plotlyjs()


def missing(library: str, error: ImportError) -> ViewerError:
    """What to say where a library of the extra `dash` is not installed."""
    need = f"the page of a league needs {library} ({error}); install it with: pip install 'robot-league[dash]'"
    return ViewerError(need)


def _policy(*scripts: str) -> str:
    """The browser runs these scripts and no other, and fetches nothing."""
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:"


def _static(name: str) -> str:
    return (resources.files("dashboards") / "static" / name).read_text("utf-8")


def _section(section: Section) -> str:
    parts = "\n".join(_parts(section))
    name = escape(section.id)
    head = f'<h2 id="{name}-title">{escape(section.title)}</h2>'
    return f'<section id="{name}" aria-labelledby="{name}-title">\n{head}\n{parts}\n</section>'


def _parts(section: Section) -> Iterator[str]:
    for number, part in enumerate(section.parts):
        name = f"{escape(section.id)}-{number}"
        match part:
            case str():
                yield f'<p class="notes" id="{name}" data-block>{escape(part)}</p>'
            case Rows():
                yield f'<div id="{name}" data-block {_region(part.name)}>{part.markup}</div>'
            case Picture():
                yield _picture(name, part)
            case Pairs():
                yield _pairs(name, part)


def _region(name: str) -> str:
    """The attributes of what scrolls by itself."""
    return f'class="rows" role="region" tabindex="0" aria-label="{escape(name)}"'


def _picture(name: str, part: Picture) -> str:
    return (
        f'<figure id="{name}" data-block><div class="plot" role="img" aria-labelledby="{name}-told"'
        f' style="height: {part.figure["layout"]["height"]}px"></div>'
        f'<figcaption id="{name}-told">{escape(part.told)}</figcaption>{_embedded(part.figure)}</figure>'
    )


def _pairs(name: str, part: Pairs) -> str:
    lists = "".join(
        f'<label>{said} <select><option value="">choose</option>{_options(names)}</select></label>\n'
        for said, names in (("of", part.firsts), ("and", part.seconds))
    )
    return (
        f'<fieldset class="pairs" id="{name}" data-block><legend>{escape(part.name)}</legend>\n{lists}'
        f'<div {_region(part.name)} aria-live="polite" hidden></div>'
        f"{_embedded({'heads': part.heads, 'found': part.found, 'led': part.led})}</fieldset>"
    )


def _options(names: Sequence[str]) -> str:
    return "".join(f"<option>{escape(name)}</option>" for name in names)


def _embedded(value: Any) -> str:
    """JSON that no HTML parser takes for the end of the script that it stands in. Raises ValueError for nan."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    text = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return f'<script type="application/json">{text}</script>'
