"""Hooks of mkdocs: README as first page, its table of pages as navigation, linked files outside `docs/` as pages.

Links in the Markdown files are those of the repository, so they work where the code is hosted. Here a link that leaves
`docs/` gets a page of the site: Markdown files as they are, other files as code. A link to what does not exist stays as
it is, and the strict build refuses it.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the tests of links need no mkdocs
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
HOME = "README.md"
KEPT = (".md", ".png", ".webp", ".jpg", ".gif", ".svg")
"""Endings of files that the site has as they are. Others are shown as code."""
FENCE = re.compile(r"^ *(```|~~~)")
LINK = re.compile(
    r"`[^`]*`|(?<=\]\()(?P<target>[^)\s#]+)(?=[)#\s])"
)  # code first: what looks like a link there is none
ROW = re.compile(r"^\| (?P<section>[^|]+) \| (?P<links>.*\]\(.*) \|$")
NAMED = re.compile(r"\[(?P<name>[^]]+)\]\((?P<target>[^)]+)\)")
FOREIGN = re.compile(r"^[a-z]+:")


def prose(markdown: str) -> Iterator[tuple[bool, str]]:
    """Yield (whether it is text, not code, line) for every line."""
    code = False
    for line in markdown.splitlines(keepends=True):
        fence = FENCE.match(line) is not None
        yield not (code or fence), line
        code ^= fence


def links(markdown: str) -> Iterator[str]:
    """Yield the targets of links and pictures, without anchors and other hosts."""
    for text, line in prose(markdown):
        for found in LINK.finditer(line) if text else ():
            if found["target"] and not FOREIGN.match(found["target"]):
                yield found["target"]


def resolved(file: str, target: str) -> str:
    """Return the path in the repository that a link of `file` (a path in the repository) means."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(file), target))


def reachable(start: str = HOME) -> set[str]:
    """Return the paths of all files of the repository to which links lead from a Markdown file."""
    seen, waiting = set(), [start]
    while waiting:
        file = waiting.pop()
        if file in seen or not (ROOT / file).is_file():
            continue
        seen.add(file)
        if file.endswith(".md"):
            waiting += [resolved(file, target) for target in links((ROOT / file).read_text("utf-8"))]
    return seen


def place(file: str) -> str:
    """Return where mkdocs has a file of the repository: below `docs/` as there, elsewhere as in the repository."""
    if file == HOME:
        return "index.md"
    if file.startswith("docs/"):
        return file.removeprefix("docs/")
    return file if file.endswith(KEPT) else f"{file}.md"


def origin(page: str) -> str:
    """Return the file of the repository that mkdocs has at a place: the inverse of `place`."""
    if page == "index.md":
        return HOME
    if (ROOT / "docs" / page).is_file():
        return f"docs/{page}"
    return page if (ROOT / page).is_file() else page.removesuffix(".md")


def navigation(readme: str) -> list[dict]:
    """Return mkdocs' navigation as README's table of pages has it; a row without bold is part of the section above."""
    sections: list[dict] = []
    _, _, table = readme.partition("\n## Pages\n")
    for line in table.partition("\n## ")[0].splitlines():
        row = ROW.match(line)
        if not row:
            continue
        entries: list[dict] = [
            {found["name"][0].upper() + found["name"][1:]: place(found["target"])}
            for found in NAMED.finditer(row["links"])
            if (ROOT / found["target"]).is_file()
        ]
        name = row["section"].strip("* ")
        if row["section"].startswith("**"):
            sections.append({name: entries})
        else:
            next(iter(sections[-1].values())).append({name: entries})
    next(iter(sections[0].values())).insert(0, {"Overview": place(HOME)})
    return sections


def on_config(config: MkDocsConfig) -> None:
    """Set the navigation."""
    config.nav = navigation((ROOT / HOME).read_text("utf-8"))


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add README, and what links lead to outside `docs/`."""
    from mkdocs.structure.files import File

    for file in sorted(reachable()):
        if file.startswith("docs/"):
            continue
        if file.endswith(KEPT) and not file.endswith(".md"):
            files.append(File.generated(config, file, abs_src_path=str(ROOT / file)))
            continue
        text = (ROOT / file).read_text("utf-8")
        if not file.endswith(".md"):
            language = Path(file).suffix.lstrip(".") or "text"
            text = f"---\nsearch: {{exclude: true}}\n---\n# {file}\n\n~~~~{language}\n{text.rstrip()}\n~~~~\n"
        files.append(File.generated(config, place(file), content=text))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links of the repository into links of the site."""
    file, here = origin(page.file.src_uri), posixpath.dirname(page.file.src_uri)

    def moved(found: re.Match) -> str:
        target = found["target"]
        if not target or FOREIGN.match(target) or not (ROOT / resolved(file, target)).is_file():
            return found[0]
        return posixpath.relpath(place(resolved(file, target)), here or ".")

    return "".join(LINK.sub(moved, line) if text else line for text, line in prose(markdown))
