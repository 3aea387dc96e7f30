"""The part of an arena's page that the arena itself writes: python -m league.pages writes it into all of docs/arenas.

A page has it between two lines; around them people write. One page may be of several arenas: which ones their settings
say (`Outline.page`), and what they have in common stands there once.
"""

import re
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from arenas import known
from league import sheets
from league.sheets import Row, Sheet

BEGIN = "<!-- written by the arenas themselves: python -m league.pages -->"
END = "<!-- to here -->"
T = TypeVar("T")
K = TypeVar("K", bound=Hashable)
ROOT = Path(__file__).parents[1]


def pages() -> dict[str, list[str]]:
    """Each page's file, relative to the repository, and the arenas that it is of."""
    found: dict[str, list[str]] = {}
    for name, settings in known().items():
        found.setdefault(f"docs/arenas/{sheets.outline(settings).page}.md", []).append(name)
    return found


def part(begin: str = BEGIN) -> re.Pattern[str]:
    """A part of a page that a program writes, from the line `begin` to END."""
    return re.compile(f"{re.escape(begin)}\n(?:(?!<!--).*\n)*{re.escape(END)}")


def replaced(text: str, begin: str, written: str) -> str:
    """A page's text with what is `written` after the line `begin`; ValueError where it has no such part, or two."""
    if len(part(begin).findall(text)) != 1:
        raise ValueError(f"the page must have one part between the lines {begin} and {END}")
    return part(begin).sub(lambda _: f"{begin}\n{written}\n{END}", text)


def rewritten(text: str, arenas: Sequence[Sheet]) -> str:
    """A page's text with the arenas' part as it is now. Raises ValueError for a page that has no such part, or two."""
    return replaced(text, BEGIN, told(arenas))


def told(arenas: Sequence[Sheet]) -> str:
    """What a page tells of its arenas, in Markdown."""
    parts = [table([sheets.line(each.name, each.outline) for each in arenas], LIST)]
    parts += [f"![A match between scripts in {each.name}](../{each.picture.removeprefix('docs/')})" for each in arenas]
    roles = [(each.name, role) for each in arenas for role in each.roles]
    for (kind, parts_seen), names in _together(roles, lambda role: (role.kind, role.observation)):
        size = sheets.size(parts_seen)
        parts += [f"### What {_a(kind)} sees in {names}: {size}", table(sheets.part_rows(parts_seen), PARTS)]
    for (kind, parts_done), names in _together(roles, lambda role: (role.kind, role.action)):
        parts += [f"### What {_a(kind)} does in {names}: {sheets.size(parts_done)}"]
        parts += [table(sheets.part_rows(parts_done), PARTS)]
    legends = [(each.name, each) for each in arenas]
    for _, names in _together(legends, lambda each: (each.legend.score, *map(str, sheets.term_rows(each.legend)))):
        legend = next(each.legend for each in arenas if f"`{each.name}`" in names)
        parts += [
            f"### Score and reward in {names}",
            f"Score: {legend.score}.",
            table(sheets.term_rows(legend), TERMS),
        ]
    parts += ["### Scripts", table(_scripts(arenas), ("arena", "team", "scripts"))]
    return "\n\n".join(parts)


LIST = ("arena", "teams", "decisions_per_second", "episode", "sees", "what")
PARTS = ("index", "what", "unit", "meaning")
TERMS = ("name", "kind", "what")
TITLES = {"decisions_per_second": "decisions per second", "episode": "seconds", "sees": "numbers seen"}


def _scripts(arenas: Iterable[Sheet]) -> list[Row]:
    return [{"arena": each.name, **row} for each in arenas for row in sheets.team_rows(each)]


def _together(named: Iterable[tuple[str, T]], key: Callable[[T], K]) -> list[tuple[K, str]]:
    """Things of arenas that are alike, and the arenas' names, in the order in which they first appear."""
    found: dict[K, dict[str, None]] = {}
    for name, thing in named:
        found.setdefault(key(thing), {})[name] = None
    return [(like, ", ".join(f"`{name}`" for name in names)) for like, names in found.items()]


def table(rows: Iterable[Row], columns: Sequence[str]) -> str:
    """Rows as a table in Markdown."""
    lines = [[TITLES.get(column, column) for column in columns], ["---"] * len(columns)]
    lines += [[_cell(row[column]) for column in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).replace("|", "\\|")


def _a(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def main() -> None:
    """Write the arenas' part of every page."""
    for file, names in pages().items():
        path = ROOT / file
        text = rewritten(path.read_text("utf-8"), [sheets.sheet(known()[name]) for name in names])
        path.write_text(text, "utf-8")
        print(f"{file}: {', '.join(names)}")


if __name__ == "__main__":
    main()
