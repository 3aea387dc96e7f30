"""Rows of an entry that is being played, in a file beside the one to come: the same command goes on from them."""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from league.runs.bench.entry_file import LIMIT, EntryError
from storage.blobs.files import open_file, replacement_file

Row = Mapping[str, Any]
SHOWN = 16  # characters of a value in a message, enough of a digest


class PartialRows:
    """Rows that an entry has so far, and the seconds that it took; in memory alone without a `path`.

    `entry` is all that decides the rows, as JSON: a file of another one is refused, since its games would be mixed in.
    """

    def __init__(self, path: Path | None, entry: Mapping[str, Any]):
        """Read what an earlier run left. Raises EntryError, one line, for a file of another entry or a damaged one."""
        self._path, self._entry = path, entry
        self._rows: list[Row] = []
        self._began = time.monotonic()
        if path is not None and path.exists():
            self._go_on(path)

    @property
    def seconds(self) -> float:
        """Seconds that the rows took, those of earlier runs included."""
        return time.monotonic() - self._began

    def find(self, **fields: Any) -> Row | None:
        """Return the row with these values, if there is one."""
        return next((row for row in self._rows if all(row.get(key) == value for key, value in fields.items())), None)

    def add(self, row: Row) -> Row:
        """Write a row to the file, and return it. Raises StorageError, Unavailable where the disk is full."""
        self._rows.append(row)
        if self._path is not None:
            content = {"entry": self._entry, "seconds": round(self.seconds, 1), "rows": self._rows}
            with replacement_file(self._path) as file:
                file.write_text(json.dumps(content))
        return row

    def _go_on(self, path: Path) -> None:
        with open_file(path) as file:
            data = file.read(LIMIT)
        try:
            content = json.loads(data)
            other, seconds = dict(content["entry"]), float(content["seconds"])
            rows = [dict(row) for row in content["rows"]]
        except (ValueError, TypeError, KeyError, RecursionError):
            raise EntryError(f"{path} is damaged: remove it, and all games are played anew.") from None
        if different := [key for key in self._entry if other.get(key) != self._entry[key]]:
            before, now = (str(each.get(different[0], "none"))[:SHOWN] for each in (other, self._entry))
            raise EntryError(
                f"{path} has games of an entry with another {different[0]} ({before}, now {now}): give another --out,"
                " or remove it."
            )
        self._rows.extend(rows)
        self._began -= seconds
