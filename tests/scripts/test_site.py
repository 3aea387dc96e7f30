"""Links of the pages lead somewhere, every page can be reached, and the site builds in mkdocs' strict mode."""

import os
import re
import subprocess
import sys

import pytest

from scripts import site_hooks as site

READ = sorted(file for file in site.reachable() if file.endswith(".md"))


def test_every_page_is_reached_from_readme():
    pages = {file.relative_to(site.ROOT).as_posix() for file in (site.ROOT / "docs").rglob("*.md")}
    assert pages - set(READ) == set()


@pytest.mark.parametrize("file", READ)
def test_links_lead_to_files(file):
    targets = site.links((site.ROOT / file).read_text("utf-8"))
    assert [target for target in targets if not (site.ROOT / site.resolved(file, target)).is_file()] == []


def test_links_in_code_are_none():
    text = "[a](a.md) `[b](b.md)` [c](https://c.md) ![d](d.png)\n```\n[e](e.md)\n```\n[f](f.md#part)\n"
    assert list(site.links(text)) == ["a.md", "d.png", "f.md"]


def test_a_place_in_the_site_is_that_of_one_file():
    assert {site.origin(site.place(file)) for file in site.reachable()} == site.reachable()


def test_the_navigation_is_readmes_table():
    sections = {
        name: entries
        for section in site.navigation((site.ROOT / site.HOME).read_text())
        for name, entries in section.items()
    }
    assert list(sections) == ["Begin", "Guides", "Reference", "Design", "Evidence"]
    assert sections["Begin"][0] == {"Overview": "index.md"}
    assert {"Sumo": "arenas/sumo.md"} in next(entry["Arenas"] for entry in sections["Reference"] if "Arenas" in entry)


def test_the_site_builds_and_loads_nothing_from_other_hosts(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    # Not `--quiet`: mkdocs would then count no warning, and call a site with broken links a success.
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path],
        cwd=site.ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > len(READ)
    for page in pages:
        loaded = re.findall(r"<(?!a\b)\w[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>", page.read_text("utf-8"))
        assert loaded == [], page
    assert (tmp_path / "search" / "search_index.json").stat().st_size > 100_000
