"""Clips of a league's recorded matches: made before a report is written, or in a thread beside a server."""

import hashlib
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from dashboards.errors import ViewerError
from dashboards.film.clips import Clip, Clips
from league.queries.match_players import players_of
from league.queries.query import Open
from league.queries.recordings import describe_match, highlights, load, recorded
from league.system.environment import cache_folder
from matchmaking.ratings.ladder import Ladder
from storage.errors import StorageError
from storage.recordings.recording import Recording
from storage.records import Match, RankedMatch

REST_SECONDS = 20.0
"""Rest of the thread between two looks at the league, so that a league that plays without a pause costs little."""
NO_CLIPS = "Films were left out by --films 0."
LOWEST_PRIORITY = 19  # as of nice(1): a league that trains here comes first

Progress = Callable[[int, int], None]


class ShownClip(NamedTuple):
    """A clip with the text beside it."""

    path: Path
    caption: str


def kept_clips() -> Clips:
    """Return the clips of all leagues, in this user's cache folder (ROBOT_LEAGUE_CACHE moves it)."""
    return Clips(cache_folder() / "clips")


def make_clips(
    opened: Open, most: int, progress: Progress = lambda done, total: None, ladder: Ladder | None = None
) -> list[ShownClip]:
    """Return clips of up to `most` matches, the newest first; make those that are not kept yet.

    `ladder`, that of the newest rating matches, saves reading if the caller has it already. A match whose recording
    cannot be read is left out. Raises ViewerError without ffmpeg or Pillow; StorageError if
    nothing was recorded, or if the clips cannot be written.
    """
    return list(_clips(opened, most, progress, ladder))


def _clips(opened: Open, most: int, progress: Progress, ladder: Ladder | None = None) -> Iterator[ShownClip]:
    for kind, match in highlights(opened, most, ladder):
        try:
            recording, _ = load(opened, match)
            players = players_of(opened, match, recording.header.sides)
        except StorageError:  # damaged; `league watch` says how
            continue
        clip = kept_clips().make(recording, players, progress)
        yield ShownClip(clip.path, _caption(kind, match, recording, clip))


def _caption(kind: str, match: Match | RankedMatch, recording: Recording, clip: Clip) -> str:
    part = f", the last {clip.end - clip.begin:.0f} s of it" if clip.begin > recording.time[0] else ""
    return f"{kind.capitalize()}. {describe_match(match, recording)}{part}. In 3D: `league watch {match.id}`."


class BackgroundClips:
    """The clips of a league that may still run, made one after the other in a thread of the lowest priority."""

    def __init__(self, now: Callable[[], Open], most: int):
        """Make clips of up to `most` matches of the league that `now` opens."""
        self._now, self._most = now, most
        self._over, self._revision = threading.Event(), (None, -1)
        self.shown: Sequence[ShownClip] = ()
        self.note = "The film of the newest match is being made." if most else NO_CLIPS

    @contextmanager
    def running(self) -> Iterator[None]:
        """Make clips during the block."""
        try:
            recorded(self._now())
        except StorageError as error:  # nothing yet
            self.note = str(error)
        thread = threading.Thread(target=self._run, name="clips", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()

    @property
    def version(self) -> str:
        """A text that changes whenever `shown` or the note does."""
        text = "\n".join([self.note, *(f"{clip.path.name} {clip.caption}" for clip in self.shown)])
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def path(self, name: str) -> Path | None:
        """Return the file of a clip that is shown, by its name."""
        return next((clip.path for clip in self.shown if clip.path.name == name), None)

    def _run(self) -> None:
        if sys.platform == "linux":  # where a thread has a priority of its own
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST_PRIORITY)
        with suppress(_StoppedError):
            while True:
                try:
                    self._look()
                except ViewerError as error:
                    self.note = f"No films: {error}."
                    return
                except StorageError as error:
                    self.note = str(error)
                if self._over.wait(REST_SECONDS):
                    return

    def _look(self) -> None:
        """Make what is missing. Old clips are shown until all of the new ones are there, or while there are none."""
        opened = self._now()
        revision = opened.league, opened.store.revision(opened.league)
        if revision == self._revision:
            return
        made: list[ShownClip] = []
        for clip in _clips(opened, self._most, self._go_on):
            made.append(clip)
            if len(made) > len(self.shown):
                self.shown = tuple(made)
        self.shown, self._revision = tuple(made), revision

    def _go_on(self, done: int, total: int) -> None:
        """Leave the making of a clip, without a trace, once the block has ended."""
        if self._over.is_set():
            raise _StoppedError


class _StoppedError(Exception):
    """The server ends."""
