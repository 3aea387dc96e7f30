"""On which line of a TOML text each key stands: what `tomllib` does not tell, and an error message needs."""

import re
import tomllib
from collections.abc import Iterator

from league.settings import Key

_TOKEN = re.compile(
    r'''"""(?:\\.|[^\\])*?"{3,5}|\'{3}.*?\'{3,5}'''  # strings over several lines; up to two quotes may precede the end
    r"""|"(?:\\.|[^"\\])*"|'[^']*\'"""
    r"""|\#[^\n]*|\n|[][{}=,]|[^]\s[{}=,\#"']+""",
    re.DOTALL,
)


def _tokens(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, token) for every token but comments."""
    line, last = 1, 0
    for found in _TOKEN.finditer(text):
        line += text.count("\n", last, found.start())
        last = found.start()
        if not found[0].startswith("#"):
            yield line, found[0]


def _names(token: str) -> list[str]:
    """Split the token of a dotted key: `a.b` is two names, `"a.b"` is one."""
    if token[0] in "\"'":
        return [tomllib.loads(f"name = {token}")["name"]]
    return [name for name in token.split(".") if name]


def key_lines(text: str) -> dict[Key, int]:
    """Map every key and table of a valid TOML text to the line (from 1) where it is first named."""
    lines: dict[Key, int] = {}
    table: Key = ()  # of the last [header]
    brackets: list[tuple[str, Key]] = []  # open ones of a value, with the key that inner keys extend
    parent, names, in_key = table, [], True

    def note(key: Key, line: int) -> None:
        for depth in range(1, len(key) + 1):
            lines.setdefault(key[:depth], line)

    for line, token in _tokens(text):
        if token == "\n":
            if not brackets:
                parent, names, in_key = table, [], True
        elif in_key and token == "=":
            note((*parent, *names), line)
            in_key = False
        elif in_key and token == "[":  # a header, since no key is open
            parent = ()
        elif in_key and token == "]":
            table = tuple(names)
            note(table, line)
        elif in_key and token not in "{},":
            names += _names(token)
        elif token in "[{":
            brackets.append((token, (*parent, *names)))
            if token == "{":
                parent, names, in_key = (*parent, *names), [], True
        elif token in "]}":
            _, key = brackets.pop()
            parent, names, in_key = key, [], False
        elif token == "," and brackets[-1][0] == "{":
            parent, names, in_key = brackets[-1][1], [], True
    return lines
