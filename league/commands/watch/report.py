"""`league report`: a league as one file to look at or to send."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dashboards.errors import ViewerError
from league.commands.options import parse, spelt
from league.commands.progress_bar import Progress
from league.commands.watch.page_options import PageOptions
from league.config.schema import ConfigError
from league.queries.query import Open
from league.state.league_state import LeagueState
from matchmaking.ratings.ladder import Ladder
from storage.blobs.files import new_file
from storage.errors import StorageError

if TYPE_CHECKING:
    from dashboards.web.document import FilmBlock


@dataclass(frozen=True)
class ReportOptions(PageOptions):
    """The league, its films, and the file to write."""

    output: str | None = None
    """The file to write, also as -o FILE; never over another one."""


def report(args: list[str]) -> int:
    """Write the page of a league."""
    what = "A league as one HTML file: who leads, films, ladder, payoffs, opponents, curves, jobs, lineage."
    options = parse(ReportOptions, spelt(args), "report", what)
    if not options.output:
        raise ConfigError((), "league report needs -o FILE: see league report --help")
    from dashboards.web.document import document, script
    from league.queries.page.league_page import page

    path = Path(options.output)
    with options.open() as opened:
        script("plotly.js")  # its absence is told before films are made
        with new_file(path) as file:
            state = LeagueState.of(opened.store, opened.league)
            films = _films(opened, options.films, state.ladder)
            text = document(page(opened, films=films, state=state)).encode()
            file.write(text)
    missing = "" if films[0].source else f" {films[0].caption}"
    print(f"Wrote {path} ({len(text):,} bytes): any browser opens it, and it needs nothing else.{missing}")
    return 0


def _films(opened: Open, most: int, ladder: Ladder) -> "list[FilmBlock]":
    """Return films that need no file; or one without a film, whose caption says why there is none."""
    from dashboards.web.document import FilmBlock
    from league.matches.match_clips import NO_CLIPS, make_clips

    if not most:
        return [FilmBlock(NO_CLIPS)]
    try:
        with Progress("league report") as progress:
            made = make_clips(opened, most, partial(progress.tell, "pictures of a film"), ladder)
    except ViewerError as error:
        return [FilmBlock(f"No films: {error}.")]
    except StorageError as error:
        return [FilmBlock(str(error))]
    films = [FilmBlock.embedded(clip.path, clip.caption) for clip in made]
    return films or [FilmBlock("No recording can be read: `league verify` tells why.")]
