"""Every arena has a page that says what the arena is now, and a picture."""

import re
from pathlib import Path

import pytest

import arenas
from league.queries import arena_info
from scripts import arena_pages

PAGES = arena_pages.pages()
BEGINNINGS = {".png": b"\x89PNG", ".webp": b"RIFF"}  # of a picture's bytes; a film is a .webp


def test_every_arena_has_a_page():
    assert sorted(name for names in PAGES.values() for name in names) == arenas.names()


@pytest.mark.parametrize("file", PAGES)
def test_a_page_says_what_its_arenas_are(file):
    text = (arena_pages.ROOT / file).read_text("utf-8")
    assert text == arena_pages.rewritten(text, [arena_info.sheet(arenas.settings(name)) for name in PAGES[file]]), (
        "the arenas have changed since: python -m scripts.arena_pages"
    )


@pytest.mark.parametrize("file", PAGES)
def test_a_page_has_no_other_table_of_indices(file):
    text = (arena_pages.ROOT / file).read_text("utf-8")
    assert not re.search(r"^\| index", arena_pages.part().sub("", text), re.MULTILINE)


@pytest.mark.parametrize("file", PAGES)
def test_the_pictures_and_files_that_a_page_names_are_there(file):
    page = arena_pages.ROOT / file
    text = page.read_text("utf-8")
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", text)
    assert {f"../pictures/arenas/{name}.webp" for name in PAGES[file]} <= set(pictures)
    for picture in pictures:
        assert (page.parent / picture).read_bytes().startswith(BEGINNINGS[Path(picture).suffix])
    files = re.findall(r"`((?:arenas|tests|benchmarks)/[\w/]+\.py)`", text)
    assert [each for each in files if not (arena_pages.ROOT / each).exists()] == []


def test_a_page_of_an_arena_that_changed_is_noticed():
    found = arena_info.sheet(arenas.settings("matching-pennies"))
    text = f"# Page\n\n{arena_pages.BEGIN}\n{arena_pages.markdown([found])}\n{arena_pages.END}\nmore\n"
    assert arena_pages.rewritten(text, [found]) == text
    wrong = text.replace("| 0 | one |", "| 1 | one |")
    assert wrong != text
    assert arena_pages.rewritten(wrong, [found]) == text
    with pytest.raises(ValueError, match="one part between the lines"):
        arena_pages.rewritten("# Page\n", [found])
