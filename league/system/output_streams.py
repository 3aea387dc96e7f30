"""Standard output and standard error of a command: every printed character passes through this module.

Control characters in foreign text are made visible (`dashboards/untrusted_text.py`), a character that the encoding
lacks is replaced, and output that cannot be written raises an error of its own: the reader left, or the disk is full.
"""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from dashboards.untrusted_text import encodable, visible_lines
from storage.errors import disk_error

OWN = re.compile(r"(\r\x1b\[K|\x1b\[(?:[0-4]|[39][0-7]|38;5;[0-9]{1,3})?(?:;(?:[0-4]|[39][0-7]))*m)")
"""Terminal sequences that our own lines use: restart of the line, and rich's colours."""


class ReaderLeft(Exception):  # noqa: N818  (not an error: `league matches | head`)
    """Standard output has no reader any more."""


class Outlet:
    """A text stream that replaces `sys.stdout` or `sys.stderr`. All other methods are those of the original stream."""

    def __init__(self, stream: Any, fallible: bool):
        """Write to `stream`; if not `fallible`, drop text that cannot be written."""
        self._stream, self._fallible = stream, fallible

    def write(self, text: str) -> int:
        """Write text; raises ReaderLeft, or StorageError if the output cannot be written."""
        safe = self._safe(text)
        try:
            try:
                self._stream.write(safe)
            except UnicodeEncodeError:
                self._stream.write(encodable(safe, self._stream.encoding))
        except OSError as error:
            self._refused(error)
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write lines, as `write` does."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream; raises as `write` does."""
        try:
            self._stream.flush()
        except OSError as error:
            self._refused(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _safe(self, text: str) -> str:
        if "\x1b" not in text or not self._stream.isatty():
            return visible_lines(text)
        parts = OWN.split(text)  # matches are at odd indices
        return "".join(part if at % 2 else visible_lines(part) for at, part in enumerate(parts))

    def _refused(self, error: OSError) -> None:
        """Drop the stream's buffer, else Python would write it again at exit; then raise the error."""
        with suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
        if not self._fallible:
            return
        if isinstance(error, BrokenPipeError):
            raise ReaderLeft from error
        raise disk_error("Cannot write to standard output", error) from error


@contextmanager
def installed() -> Iterator[None]:
    """Replace both streams by an Outlet during the context."""
    out, err = sys.stdout, sys.stderr
    if isinstance(out, Outlet):
        yield
        return
    sys.stdout, sys.stderr = Outlet(out, fallible=True), Outlet(err, fallible=False)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err
