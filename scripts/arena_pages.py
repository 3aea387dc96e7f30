"""The generated part of each arena's page: python -m scripts.arena_pages writes it into all pages of docs/arenas.

The part stands between two marks; the rest of a page is written by hand. Several arenas may share a page
(`Outline.page`); what they have in common is listed once.
"""

import re
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from arenas import known
from league.queries import arena_info
from league.queries.arena_info import Row, Sheet

BEGIN = "<!-- written by the arenas themselves: python -m scripts.arena_pages -->"
END = "<!-- to here -->"
T = TypeVar("T")
K = TypeVar("K", bound=Hashable)
ROOT = Path(__file__).parents[1]


def pages() -> dict[str, list[str]]:
    """Return each page's file, relative to the repository, and the names of its arenas."""
    found: dict[str, list[str]] = {}
    for name, settings in known().items():
        found.setdefault(f"docs/arenas/{arena_info.outline(settings).page}.md", []).append(name)
    return found


def part(begin: str = BEGIN) -> re.Pattern[str]:
    """Return the pattern of a generated part of a page, from the line `begin` to END."""
    return re.compile(f"{re.escape(begin)}\n(?:(?!<!--).*\n)*{re.escape(END)}")


def replaced(text: str, begin: str, written: str) -> str:
    """Return a page with its part after the line `begin` replaced. Raises ValueError unless there is exactly one."""
    if len(part(begin).findall(text)) != 1:
        raise ValueError(f"the page must have one part between the lines {begin} and {END}")
    return part(begin).sub(lambda _: f"{begin}\n{written}\n{END}", text)


def rewritten(text: str, arenas: Sequence[Sheet]) -> str:
    """Return a page with its generated part up to date. Raises ValueError unless there is exactly one."""
    return replaced(text, BEGIN, markdown(arenas))


def markdown(arenas: Sequence[Sheet]) -> str:
    """Format the description of a page's arenas in Markdown."""
    parts = [table([arena_info.line(each.name, each.outline) for each in arenas], LIST)]
    parts += [f"![A match between scripts in {each.name}](../{each.picture.removeprefix('docs/')})" for each in arenas]
    roles = [(each.name, role) for each in arenas for role in each.roles]
    for (kind, parts_seen), names in _together(roles, lambda role: (role.kind, role.observation)):
        size = arena_info.size(parts_seen)
        parts += [f"### What {_a(kind)} sees in {names}: {size}", table(arena_info.part_rows(parts_seen), PARTS)]
    for (kind, parts_done), names in _together(roles, lambda role: (role.kind, role.action)):
        parts += [f"### What {_a(kind)} does in {names}: {arena_info.size(parts_done)}"]
        parts += [table(arena_info.part_rows(parts_done), PARTS)]
    legends = [(each.name, each) for each in arenas]
    for _, names in _together(legends, lambda each: (each.legend.score, *map(str, arena_info.term_rows(each.legend)))):
        legend = next(each.legend for each in arenas if f"`{each.name}`" in names)
        parts += [
            f"### Score and reward in {names}",
            f"Score: {legend.score}.",
            table(arena_info.term_rows(legend), TERMS),
        ]
    parts += ["### Scripts", table(_scripts(arenas), ("arena", "team", "scripts"))]
    return "\n\n".join(parts)


LIST = ("arena", "teams", "decisions_per_second", "episode", "sees", "what")
PARTS = ("index", "what", "unit", "meaning")
TERMS = ("name", "kind", "what")
TITLES = {"decisions_per_second": "decisions per second", "episode": "seconds", "sees": "numbers seen"}


def _scripts(arenas: Iterable[Sheet]) -> list[Row]:
    return [{"arena": each.name, **row} for each in arenas for row in arena_info.team_rows(each)]


def _together(named: Iterable[tuple[str, T]], key: Callable[[T], K]) -> list[tuple[K, str]]:
    """Group equal things of arenas with the names of the arenas, in the order of first appearance."""
    found: dict[K, dict[str, None]] = {}
    for name, thing in named:
        found.setdefault(key(thing), {})[name] = None
    return [(like, ", ".join(f"`{name}`" for name in names)) for like, names in found.items()]


def table(rows: Iterable[Row], columns: Sequence[str]) -> str:
    """Format rows as a Markdown table."""
    lines = [[TITLES.get(column, column) for column in columns], ["---"] * len(columns)]
    lines += [[_cell(row[column]) for column in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).replace("|", "\\|")


def _a(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def main() -> None:
    """Write the generated part of every page."""
    for file, names in pages().items():
        path = ROOT / file
        text = rewritten(path.read_text("utf-8"), [arena_info.sheet(known()[name]) for name in names])
        path.write_text(text, "utf-8")
        print(f"{file}: {', '.join(names)}")


if __name__ == "__main__":
    main()
