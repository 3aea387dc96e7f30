"""`league bench page FOLDER` and `league bench rerate FOLDER`: a folder of entries as a page, and computed again."""

from dataclasses import dataclass
from pathlib import Path

from league.commands.options import parse, positional, spelt
from storage.blobs.files import new_file

PAGE = "Write the table of a folder of entries as one HTML file, which needs nothing else."
RERATE = """Compute the ratings of a folder of entries again from their rows, and say what differs; exit code 1 if
something does."""


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """The entries, and the page."""

    folder: str = positional()
    """The folder with the JSON files that `league bench` wrote."""
    out: str = "bench.html"
    """The file to write; never over another one."""


@dataclass(frozen=True, kw_only=True)
class RerateOptions:
    """The entries."""

    folder: str = positional()
    """The folder with the JSON files that `league bench` wrote."""


def page(args: list[str]) -> int:
    """Write the page of a folder of entries."""
    options = parse(PageOptions, spelt(args), "bench page", PAGE)
    from dashboards.web.document import document, script
    from league.runs.bench import bench_page, entry_file, rerating

    entries, path = entry_file.folder(Path(options.folder)), Path(options.out)
    rerating.check(entries)
    script("plotly.js")  # its absence is told before anything is written
    text = document(bench_page.page(entries)).encode()
    with new_file(path) as file:
        file.write(text)
    print(f"Wrote {path} ({len(text):,} bytes; entries: {len(entries)}): any browser opens it.")
    return 0


def rerate(args: list[str]) -> int:
    """Compute the ratings of a folder of entries again."""
    options = parse(RerateOptions, args, "bench rerate", RERATE)
    from league.runs.bench import entry_file, rerating

    found = rerating.of_folder(entry_file.folder(Path(options.folder)))
    for path, lines in found.items():
        print(f"{path}: {'; '.join(lines) if lines else 'its rows give the same'}")
    return 1 if any(found.values()) else 0
