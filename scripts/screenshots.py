"""Take the README's pictures of a finished league: a match, the page, a terminal.

    league run --preset quickstart
    python -m scripts.screenshots league-data docs/pictures

It needs Chromium, and a graphics driver for the match (unless `--without match`).
"""

import argparse
import os
import pty
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.terminal_theme import SVG_EXPORT_THEME
from rich.text import Text

if TYPE_CHECKING:
    from playwright.sync_api import Browser

COLUMNS = "112"
SCREEN = """<pre style="display: inline-block; margin: 0; padding: 18px 22px; background: #0c0c0c; color: #d9d9d9;
font: 15px/1.25 'DejaVu Sans Mono', monospace">{code}</pre>"""

MIDDLE = """async film => {
    await film.play();
    film.pause();
    await new Promise(done => { film.onseeked = done; film.currentTime = film.duration / 2; });
}"""
"""Moves a film to its middle."""


def league(*args: str) -> str:
    """Run a `league` command in a terminal and return what it prints."""
    parts: list[bytes] = []

    def read(terminal: int) -> bytes:
        parts.append(os.read(terminal, 65_536))
        return parts[-1]

    os.environ |= {"COLUMNS": COLUMNS, "TERM": "xterm-256color"}
    if code := os.waitstatus_to_exitcode(pty.spawn([sys.executable, "-m", "league", *args], read)):
        sys.exit(code)
    return b"".join(parts).decode().replace("\r\n", "\n")


def match(store: str, out: Path, browser: "Browser") -> None:
    """Take the best two players in the ring, two thirds into their match."""
    league("watch", "--store", store, "--shot", str(out / "match.png"))


def terminal(store: str, out: Path, browser: "Browser") -> None:
    """Take `league ratings` as a terminal shows it."""
    text = Text("$ league ratings\n") + Text.from_ansi(league("ratings", "--store", store))
    console = Console(record=True, file=open(os.devnull, "w"), width=int(COLUMNS))  # noqa: SIM115
    console.print(text)
    tab = browser.new_page(device_scale_factor=1.5, viewport={"width": 1400, "height": 900})
    tab.set_content(console.export_html(theme=SVG_EXPORT_THEME, inline_styles=True, code_format=SCREEN))
    tab.locator("pre").screenshot(path=out / "terminal.png")


def page(store: str, out: Path, browser: "Browser") -> None:
    """Take the page as it opens: who leads, whether it still learns, what is wrong, and the newest film."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.html"
        league("report", "--store", store, "--films", "1", "-o", str(report))
        tab = browser.new_page(viewport={"width": 1200, "height": 740})
        tab.goto(report.as_uri())
        tab.locator("#overview .chart .main-svg").first.wait_for()
        tab.locator("video").evaluate(MIDDLE)
        tab.locator(".about").evaluate("about => about.textContent = 'Robot League'")  # without this machine's folder
        tab.wait_for_timeout(2000)  # until the player has taken its spinner away
        tab.screenshot(path=out / "page.png")


PICTURES: dict[str, Callable[[str, Path, "Browser"], None]] = {"match": match, "page": page, "terminal": terminal}


def main() -> None:
    """Take all pictures except those excluded by `--without`."""
    asked = argparse.ArgumentParser(description="Take the README's pictures of a finished league.")
    asked.add_argument("store")
    asked.add_argument("out", type=Path)
    asked.add_argument("--without", choices=PICTURES, action="append", default=[])
    options = asked.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        sys.exit("There is no Chromium: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for name, take in PICTURES.items():
            if name not in options.without:
                take(options.store, options.out, browser)


if __name__ == "__main__":
    main()
