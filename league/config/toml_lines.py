"""On which line of a TOML text each key stands: what `tomllib` does not tell, and an error message needs."""

import re
import tomllib
from collections.abc import Iterator

from league.config.schema import Key

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


class _Bracket:
    """An open bracket of a value: the key that inner keys extend and, of a list, which element is being read."""

    def __init__(self, token: str, key: Key):
        self.token, self.key, self.index = token, key, 0

    @property
    def inner(self) -> Key:
        return (*self.key, str(self.index)) if self.token == "[" else self.key


class _Tables:
    """Which table the last header opened; of a list of tables, the one that was begun last."""

    def __init__(self) -> None:
        self._last: dict[Key, int] = {}  # list of tables -> index of its last element

    def enter(self, names: list[str], is_list: bool) -> Key:
        key: Key = ()
        for depth, name in enumerate(names, 1):
            key = (*key, name)
            if is_list and depth == len(names):
                self._last[key] = self._last.get(key, -1) + 1
            if key in self._last:
                key = (*key, str(self._last[key]))
        return key


def key_lines(text: str) -> dict[Key, int]:
    """Map every key and table of a valid TOML text to the line (from 1) where it is first named.

    The elements of a list of tables are named by their index: `("players", "0", "team")`.
    """
    lines: dict[Key, int] = {}
    tables, table, header = _Tables(), (), 0  # the table of the last header, and how many brackets opened it
    brackets: list[_Bracket] = []  # open ones of a value
    parent, names, in_key = table, [], True

    def note(key: Key, line: int) -> None:
        for depth in range(1, len(key) + 1):
            lines.setdefault(key[:depth], line)

    for line, token in _tokens(text):
        if token == "\n":
            if not brackets:
                parent, names, in_key, header = table, [], True, 0
        elif in_key and token == "=":
            note((*parent, *names), line)
            in_key = False
        elif in_key and token == "[":  # a header, since no key is open
            header += 1
        elif in_key and token == "]":
            if names:
                table, names = tables.enter(names, header == 2), []
                note(table, line)
        elif in_key and token not in "{},":
            names += _names(token)
        elif token in "[{":
            brackets.append(_Bracket(token, brackets[-1].inner if brackets and not names else (*parent, *names)))
            if token == "{":
                parent, names, in_key = brackets[-1].key, [], True
                note(parent, line)
            else:
                names = []
        elif token in "]}":
            parent, names, in_key = brackets.pop().key, [], False
        elif token == "," and brackets[-1].token == "{":
            parent, names, in_key = brackets[-1].key, [], True
        elif token == ",":
            brackets[-1].index += 1
    return lines
