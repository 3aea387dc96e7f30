"""`league report`: a league as one file to look at or to send."""

from dataclasses import dataclass
from pathlib import Path

from league.commands.options import Where, parse, spelt
from league.config.schema import ConfigError
from storage.blobs.files import new_file


@dataclass(frozen=True)
class ReportOptions(Where):
    """The league, and the file to write."""

    output: str | None = None
    """The file to write, also as -o FILE; never over another one."""


def report(args: list[str]) -> int:
    """Write the page of a league."""
    what = "A league as one HTML file: ladder, ratings over training, payoffs, opponents, curves, jobs, lineage."
    options = parse(ReportOptions, spelt(args), "report", what)
    if not options.output:
        raise ConfigError((), "league report needs -o FILE: see league report --help")
    from dashboards.web.document import document
    from league.queries.page import page

    path = Path(options.output)
    with options.open() as opened:
        text = document(page(opened)).encode()
        with new_file(path) as file:
            file.write(text)
    print(f"Wrote {path} ({len(text):,} bytes): any browser opens it, and it needs nothing else.")
    return 0
