"""Description of settings by dataclass fields (a note, a type, bounds), and the check of values.

A setting may hold an int, float, bool, str, Path, Literal, tuple[T, ...], tuple[T, U], another dataclass (a table), a
tuple of those (a list of tables), a Table of any keys, or any of these or None. The string literal under a field is its
note. The field's metadata has the conditions on its value:

    lr: float = field(default=5e-4, metadata={"above": 0.0, "high": 0.1})

`low` and `high` are inclusive bounds, `above` and `below` exclusive ones (of a tuple: of every element); `valid` is a
function that raises ValueError for values that it refuses; `most` bounds the number of values in a list; `formerly` is
the name that the setting had before, and `values_formerly` those of names in a list (`league/config/former_names.py`);
`key` is its name where Python reserves that word. A class may have a dict `REMOVED`, from names of settings that it had
to lines that say why they are gone: files and stored settings may have these, without effect. Conditions on several
fields are checked in `__post_init__`, which raises ValueError("field: message") or ValueError("table.field: message"),
or any other message about the whole table; bounds are checked before it. Numbers are finite. Without an upper bound of
their own, floats are at most LARGEST and integers fit into 64 bits. Texts and lists are no longer than LONGEST and
MOST.
"""

import ast
import inspect
import json
import math
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from arenas.arena_settings import Table

Key = tuple[str, ...]
UNSET = "none"
"""The word that stands for None: TOML has no null."""

LARGEST = 1e12
"""The largest float without a bound of its own: the square of a much larger one overflows single precision."""
ECHOED = 200  # characters of a value that an error message repeats at most
DEEPEST = 500  # folders in a path; Python creates them recursively
LONGEST, MOST = 10_000, 1_000  # maximum characters of a text, and values of a list

WORDS: dict[Any, str] = {
    int: "a whole number", float: "a number", bool: "true or false", str: "text in quotes", Path: "a path in quotes",
    Table: "a table",
}  # fmt: skip
BOUNDS: dict[str, tuple[str, Callable[[Any, Any], bool]]] = {
    "low": ("at least", lambda value, bound: value >= bound),
    "above": ("above", lambda value, bound: value > bound),
    "high": ("at most", lambda value, bound: value <= bound),
    "below": ("below", lambda value, bound: value < bound),
}


class ConfigError(ValueError):
    """An invalid setting: one line with its place, the value given and the possible values."""

    def __init__(self, key: Key, message: str, place: str = ""):
        super().__init__(f"{place}{message}")
        self.key = key
        self.message = message


@cache
def hints(cls: type) -> dict[str, Any]:
    """Return the types of a class's fields, with names resolved."""
    return get_type_hints(cls)


@cache
def notes(cls: type) -> tuple[str, dict[str, str]]:
    """Return the first line of a class's docstring and the note under each of its fields, inherited ones too."""
    summary, found = "", {}
    for each in reversed([base for base in cls.__mro__ if is_dataclass(base)]):
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(each))).body[0]
        except (OSError, TypeError):  # a class made at run time or in a console has no source
            continue
        assert isinstance(body, ast.ClassDef)
        summary = (ast.get_docstring(body) or "").partition("\n")[0]
        for line, below in zip(body.body, body.body[1:], strict=False):
            match line, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = inspect.cleandoc(text)
    return summary, found


def settings(cls: Any) -> Iterator[Field]:
    """Yield the fields of a dataclass that are settings; fields marked `apart` are read and written elsewhere."""
    found = [each for each in fields(cls) if each.init and not each.metadata.get("apart")]
    return iter(sorted(found, key=lambda each: each.kw_only is True))  # an inherited one would be first


def key_of(field: Field) -> str:
    """Return the name of a setting in files and flags: that of its field, unless Python reserves it."""
    return field.metadata.get("key", field.name)


def removed(cls: Any, name: str) -> str | None:
    """Return why a class has a setting of that name no more; None if it has it, or never had it."""
    return getattr(cls, "REMOVED", {}).get(name)


def is_table(value: Any) -> bool:
    """Return whether a value is a table: a dataclass instance."""
    return is_dataclass(value) and not isinstance(value, type)


def table_of(hint: Any) -> Any:
    """Return the class of a table's type, or of the tables in a list of tables; None for any other type."""
    kind = required(hint)[0]
    if get_origin(kind) is tuple and get_args(kind)[-1] is ...:
        kind = required(get_args(kind)[0])[0]
    return kind if isinstance(kind, type) and is_dataclass(kind) else None


def inner_table(cls: type, field: Field, base: Any) -> tuple[type | None, Any]:
    """Return the class of the table, or of the list of tables, in a field, and the default table."""
    default = absent(field, base)
    if is_table(default):
        return type(default), default
    return table_of(hints(cls)[field.name]), None


def element(kind: Any, index: int) -> Any:
    """Return the type of an element of a tuple type."""
    args = get_args(kind)
    return args[0] if args[-1] is ... else args[index]


def dotted(key: Key) -> str:
    """Return a key as text: `players[1].team` for the team of the second player."""
    return "".join(f"[{name}]" if name.isdigit() else f".{name}" for name in key).removeprefix(".")


def absent(field: Field, base: Any) -> Any:
    """Return the value of a setting that is not given: the value in `base`, else the default, else MISSING."""
    if is_table(base):
        return getattr(base, field.name)
    return field.default_factory() if field.default_factory is not MISSING else field.default


def required(hint: Any) -> tuple[Any, bool]:
    """Split `X | None` into X and whether None is allowed; X is the first of several dataclasses. Raises TypeError."""
    if get_origin(hint) not in (Union, types.UnionType):
        return hint, False
    kinds = [kind for kind in get_args(hint) if kind is not types.NoneType]
    if len(kinds) > 1 and not all(map(is_dataclass, kinds)):
        raise TypeError(f"a setting cannot be of type {hint}: league/config/schema.py lists the possible types")
    return kinds[0], types.NoneType in get_args(hint)


def literal(value: Any) -> str:
    """Write a value as TOML. `repr` gives the shortest digits that read back as the same float."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):  # JSON and TOML have the same escapes, except for one character
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(literal, value))}]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{bare(name)} = {literal(each)}" for name, each in value.items()) + "}"
    return repr(value) if isinstance(value, (int, float)) else str(value)


def bare(name: str) -> str:
    """Write a key as TOML: in quotes, unless it is made of ASCII letters, digits, - and _."""
    return name if name.replace("-", "").replace("_", "").isalnum() and name.isascii() else literal(name)


def expected(hint: Any) -> str:
    """Describe in words the values that a type allows."""
    kind, optional = required(hint)
    args = get_args(kind)
    if get_origin(kind) is Literal:
        text = f"one of {', '.join(map(literal, args))}"
    elif get_origin(kind) is tuple:
        text = f"a list, each {expected(args[0])}" if args[-1] is ... else f"[{', '.join(map(expected, args))}]"
    elif is_dataclass(kind):
        text = "a table"
    else:
        text = WORDS[kind]
    return f'{text}, or "{UNSET}"' if optional else text


def bounds(metadata: Mapping[str, Any]) -> str:
    """Describe in words the bounds of a setting; empty if there are none."""
    limits = {name: metadata[name] for name in BOUNDS if name in metadata}
    if limits.keys() == {"low", "high"}:
        return f"between {limits['low']} and {limits['high']}"
    return " and ".join(f"{BOUNDS[name][0]} {bound}" for name, bound in limits.items())


def refuse(key: Key, value: Any, reason: object) -> ConfigError:
    """Return the error for a setting with an invalid value, and the reason."""
    return ConfigError(key, f"{dotted(key)} = {cut(literal(value))}: {reason}")


def cut(text: str) -> str:
    """Return a text for an error message, without the middle if it is long."""
    return text if len(text) <= ECHOED else f"{text[:120]} ... {text[-20:]} ({len(text):,} characters)"


def _all(value: Any, holds: Callable[[Any], bool]) -> bool:
    return all(_all(each, holds) for each in value) if isinstance(value, tuple) else holds(value)


def check(config: Any, prefix: Key = ()) -> None:
    """Check every value of a tree of dataclasses against the metadata of its field.

    Raises:
        ConfigError: a value is refused, e.g. `learner.gamma = 1.5: must be between 0 and 1`.
    """
    for field in settings(config):
        key, value = (*prefix, key_of(field)), getattr(config, field.name)
        if is_table(value):
            check(value, key)
        elif isinstance(value, tuple) and any(map(is_table, value)):
            for i, each in enumerate(value):
                check(each, (*key, str(i)))
        elif value is not None:
            check_value(value, field.metadata, key)


def check_value(value: Any, metadata: Mapping[str, Any], key: Key) -> None:
    """Check one setting; raises ConfigError as `check` does."""
    if not _all(value, lambda each: not isinstance(each, float) or math.isfinite(each)):
        raise refuse(key, value, "must be finite")
    if not _all(value, lambda each: not isinstance(each, str | Path) or len(str(each)) <= LONGEST):
        raise refuse(key, value, f"has more than {LONGEST:,} characters")
    if not _all(value, lambda each: not isinstance(each, str | Path) or str(each).count("/") <= DEEPEST):
        raise refuse(key, value, f"has more than {DEEPEST} folders within each other")
    most = metadata.get("most", MOST)
    if isinstance(value, tuple) and len(value) > most:
        raise refuse(key, value, f"has {len(value):,} values; at most {most:,} are possible")
    limits = [(holds, metadata[name]) for name, (_, holds) in BOUNDS.items() if name in metadata]
    if not _all(value, lambda each: all(holds(each, bound) for holds, bound in limits)):
        raise refuse(key, value, f"must be {bounds(metadata)}")
    if not metadata.keys() & {"high", "below"}:
        if not _all(value, lambda each: not isinstance(each, float) or abs(each) <= LARGEST):
            raise refuse(key, value, f"must be between {-LARGEST:g} and {LARGEST:g}")
        if not _all(value, lambda each: not isinstance(each, int) or abs(each) < 2**63):
            raise refuse(key, value, "is beyond 64 bits")
    try:
        metadata.get("valid", lambda _: None)(value)
    except ValueError as error:
        raise refuse(key, value, error) from None
