"""Clips: short, small films of matches for pages and notebooks. Each is made once and kept in a folder."""

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from dashboards.film.film import Film, require_encoder, save_film
from dashboards.identity import MatchPlayer
from storage.errors import disk_error
from storage.recordings.recording import Recording, to_bytes

SIZE, RATE = (480, 300), 12  # pixels, pictures per second
SECONDS = 10.0
"""Maximum length. A longer match is shown from its end backwards: that is where it is decided."""
MAX_BYTES = 300_000
BIT_RATES = tuple(int(8 * MAX_BYTES / (SECONDS + 1) * share) for share in (0.8, 0.4, 0.1))
"""Bits per second, tried in turn until a clip has at most MAX_BYTES."""
KEPT = 200
"""Maximum number of clips in the folder, 60 MB at most; those used longest ago are removed."""
FORMAT = 1  # raise it when the same match is to be drawn in another way


class Clip(NamedTuple):
    """A clip in its folder, and the seconds of the match that it shows."""

    path: Path
    begin: float
    end: float


class Clips:
    """The clips in a folder, by the bytes of the recording and by what is drawn of the players."""

    def __init__(self, folder: Path):
        self.folder = folder

    def find(self, recording: Recording, players: Sequence[MatchPlayer] | None = None) -> Clip | None:
        """Return a match's clip if it has been made."""
        clip = self._clip(recording, players)
        try:
            os.utime(clip.path)  # keeps it among those used last
        except FileNotFoundError:
            return None
        except OSError:  # a folder of another user can be read
            return clip if clip.path.is_file() else None
        return clip

    def make(
        self, recording: Recording, players: Sequence[MatchPlayer] | None = None,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> Clip:  # fmt: skip
        """Return a match's clip; make it if there is none yet, in about 8 s of one core.

        Raises ViewerError without ffmpeg or Pillow, StorageError where the folder cannot be written.
        """
        if found := self.find(recording, players):
            return found
        clip = self._clip(recording, players)
        require_encoder(clip.path)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error(f"Cannot keep clips in {self.folder}", error) from error
        film = Film(recording, SIZE, players, labels=False)
        for bits in BIT_RATES:
            save_film(film, clip.path, RATE, (clip.begin, clip.end), progress, bits)
            if clip.path.stat().st_size <= MAX_BYTES:
                break
        self._remove_old()
        return clip

    def _clip(self, recording: Recording, players: Sequence[MatchPlayer] | None) -> Clip:
        drawn = f"{FORMAT} {SIZE} {RATE} {SECONDS} {players and tuple(players)}".encode()
        name = hashlib.sha256(drawn + to_bytes(recording)).hexdigest()
        first, last = float(recording.time[0]), float(recording.time[-1])
        return Clip(self.folder / f"{name}.webm", max(first, last - SECONDS), last)

    def _remove_old(self) -> None:
        with suppress(OSError):  # another process removes the same ones
            by_use = sorted(self.folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
            for path in by_use[KEPT:]:
                path.unlink()
