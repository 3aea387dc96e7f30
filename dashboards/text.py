"""Times and paragraphs as people read them."""

import shutil
import textwrap


def clock(seconds: float) -> str:
    """Return a time as h:mm:ss, or m:ss below an hour."""
    hours, rest = divmod(int(seconds), 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def wrapped(text: str) -> str:
    """Return a paragraph broken into lines of the terminal's width."""
    return textwrap.fill(text, shutil.get_terminal_size().columns)
