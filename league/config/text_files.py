"""Text files from users: encoding, Unicode form, and CSV dialect."""

import csv
import io
import sys
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path

from league.config.schema import ConfigError

SEPARATORS = (",", ";", "\t")
HEADER = 100_000
"""Characters of a text that are searched for its first line."""
STDIN = "standard input"
OTHER = ((b"\xff\xfe", "UTF-16"), (b"\xfe\xff", "UTF-16"))
"""First bytes of files in another encoding than UTF-8, and its name."""


def read(file: str) -> str:
    """Return the text of a file, `-` for standard input, in Unicode's composed form (NFC).

    Names that differ only by Unicode form (é as one character, or as e and an accent) look alike and mean the same; the
    form in a file depends on the system that wrote it. Raises ConfigError.
    """
    source = STDIN if file == "-" else file
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError((), f"cannot read {source}: {why}") from error
    return composed(decoded(data, source))


def decoded(data: bytes, source: str) -> str:
    """Decode UTF-8, without the byte-order mark that some editors write first.

    Raises ConfigError, with the first line in another encoding.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        for mark, name in OTHER:
            if data.startswith(mark):
                raise ConfigError((), f"{source} is text in {name}, not in UTF-8: save it as UTF-8") from error
        line = data.count(b"\n", 0, error.start) + 1
        what = f"{source} is not text in UTF-8: {error.reason}, 0x{data[error.start]:02x}, in line {line:,}"
        raise ConfigError((), f"{what}; save it as UTF-8") from error


def composed(text: str) -> str:
    """Return the text in Unicode's composed form (NFC)."""
    return text if text.isascii() else unicodedata.normalize("NFC", text)


def separator(text: str, wanted: Sequence[str] = ()) -> str:
    """Return the separator of a CSV text, by its first line: a comma, a semicolon or a tab.

    The separator is chosen that yields the most of the `wanted` columns, or the most fields if `wanted` is empty. On a
    tie it is the first of SEPARATORS; for a line that is not CSV it is a comma.
    """
    line = next(iter(text.lstrip()[:HEADER].splitlines()), "")

    def merit(character: str) -> int:
        fields = [field.strip() for field in next(csv.reader([line], delimiter=character, skipinitialspace=True), [])]
        return sum(name in fields for name in wanted) if wanted else len(fields)

    try:
        return max(SEPARATORS, key=merit)
    except csv.Error:
        return ","


def rows(text: str, character: str, source: str) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and fields of each line of a CSV text that is not empty. Raises ConfigError, with the line."""
    lines = csv.reader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True, delimiter=character)
    try:
        for fields in lines:
            if any(map(str.strip, fields)):
                yield lines.line_num, fields
    except csv.Error as error:
        raise refused(error, f"{source}:{lines.line_num}: ") from error


def refused(error: csv.Error, place: str) -> ConfigError:
    """Return the error for text that is not CSV."""
    if "field larger" in str(error):
        what = f"a field has more than {csv.field_size_limit():,} characters; perhaps a quotation mark was not closed"
        return ConfigError((), what, place)
    return ConfigError((), str(error), place)
