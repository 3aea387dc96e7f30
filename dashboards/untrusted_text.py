"""Untrusted text made safe to print: names, reasons and hosts from files, stores and command lines.

A terminal obeys escape sequences, a bidirectional mark reverses a line, a carriage return hides the text before it, and
a spreadsheet evaluates a cell that begins with `=`. This module makes all of these visible characters instead.
"""

import csv
import io
import sys
from collections.abc import Iterable
from typing import Any

FORMULA = ("=", "+", "-", "@")
"""Spreadsheets evaluate a text cell that begins with one of these."""

_ASCII = str.maketrans({
    "─": "-", "━": "=", "–": "-", "—": "-", "…": "...", "×": "x", "±": "+-", "·": "|", "ν": "nu", "½": "1/2", "≥": ">=",
    "≤": "<=", "−": "-", "→": "->", **dict(zip("▁▂▃▄▅▆▇█", "_.:-=+*#", strict=True)),
})  # fmt: skip
"""ASCII replacements of the symbols in our own tables and messages, for terminals and files without these characters.
"""


def json_escape(character: str) -> str:
    r"""Return a character as JSON escapes it: `\u001b`, or a surrogate pair beyond U+FFFF."""
    if (code := ord(character)) <= 0xFFFF:
        return f"\\u{code:04x}"
    high, low = divmod(code - 0x10000, 0x400)
    return f"\\u{0xD800 + high:04x}\\u{0xDC00 + low:04x}"


def visible(text: str) -> str:
    """Return text as one line in which every character is visible: all others are escaped, line ends too."""
    return text if text.isprintable() else "".join(c if c.isprintable() else json_escape(c) for c in text)


def visible_lines(text: str) -> str:
    """Return text of several lines, each as `visible`."""
    return text if text.isprintable() else "\n".join(map(visible, text.split("\n")))


def csv_cell(value: Any) -> Any:
    """Return a value of a CSV file as safe for a spreadsheet: text that it would evaluate gets an apostrophe in front.

    Numbers stay as they are. Text is escaped as by `visible`, and where standard output cannot encode it.
    """
    if not isinstance(value, str):
        return value
    text = visible(value)
    try:
        text.encode(_encoding(sys.stdout))
    except UnicodeEncodeError:
        text = "".join(c if c.isascii() else json_escape(c) for c in text)
    return f"'{text}" if text.lstrip().startswith(FORMULA) else text


def csv_line(values: Iterable[Any]) -> str:
    """Return the cells of a row as one line of CSV, without its line end; text as by `csv_cell`."""
    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow(map(csv_cell, values))
    return out.getvalue()


def encodable(text: str, encoding: str) -> str:
    """Return text that an encoding can represent: ASCII for the symbols of tables, escapes for all others."""
    return "".join(c if c.isascii() or _has(encoding, c) else _replacement(c) for c in text)


def _replacement(character: str) -> str:
    plain = character.translate(_ASCII)
    return plain if plain != character else json_escape(character)


def _has(encoding: str, character: str) -> bool:
    try:
        character.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True


def _encoding(stream: Any) -> str:
    return getattr(stream, "encoding", None) or "utf-8"
