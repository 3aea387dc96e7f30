"""Conversion of plain dictionaries, from TOML or flags, to a tree of dataclasses. Any error is one ConfigError."""

import difflib
import json
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from arenas.arena_settings import Table
from league.config.former_names import present_names
from league.config.schema import (
    UNSET,
    ConfigError,
    Key,
    absent,
    check,
    check_value,
    dotted,
    element,
    expected,
    hints,
    inner_table,
    is_table,
    key_of,
    refuse,
    required,
    settings,
    table_of,
)

T = TypeVar("T")


def build(cls: type[T], table: Mapping[str, Any], base: T | None = None) -> T:
    """Build a checked tree of dataclasses. Keys missing in `table` have their value in `base`, else their default.

    If the base or the default holds a table, the new table is of the same class: a field may allow several classes.
    Settings may have their former names.

    Raises:
        ConfigError: with the key, the value given and the possible values.
    """
    cls = cls if base is None else type(base)
    table, _ = present_names(table, cls, base)
    config = _table(cls, table, base, (), list(keys(cls, base)))
    check(config)
    return config


def keys(cls: type, base: Any = None, prefix: Key = ()) -> Iterator[Key]:
    """Yield every key that a user can set, including tables, in the order of the fields."""
    for field in settings(cls):
        key = (*prefix, key_of(field))
        yield key
        inner, default = inner_table(cls, field, base)
        if inner is not None and get_origin(required(hints(cls)[field.name])[0]) is not tuple:
            yield from keys(inner, default, key)


def _table(cls: type, table: Mapping[str, Any], base: Any, prefix: Key, everywhere: list[Key]) -> Any:
    known, values = {key_of(field): field for field in settings(cls)}, {}
    for name, value in table.items():
        key = (*prefix, name)
        if name not in known:
            raise _unknown(key, known, everywhere)
        default = absent(known[name], base)
        if isinstance(default, Table) and isinstance(value, Mapping):
            values[name] = _free_table(_laid_over(default, value), key)
        elif is_table(default) and isinstance(value, Mapping):
            values[name] = _table(type(default), value, default, key, everywhere)
        elif is_table(default) and required(hints(cls)[known[name].name])[0] is Any:
            raise refuse(key, value, f"expected a table: its settings are keys such as {_first(key, default)}")
        else:
            values[name] = _value(value, hints(cls)[known[name].name], key, everywhere)
    for name, field in known.items():
        if name not in values and absent(field, base) is MISSING:
            key = (*prefix, name)
            raise ConfigError(key, f"{dotted(key)} is missing: expected {expected(hints(cls)[field.name])}")
    for name, value in values.items():  # before a class uses the values in `__post_init__`
        if value is not None and not is_table(value):
            check_value(value, known[name].metadata, (*prefix, name))
    try:
        given = {known[name].name: value for name, value in values.items()}
        return replace(base, **given) if is_table(base) else cls(**given)
    except ArithmeticError as error:  # from a class that divides by a setting
        reason = f"{dotted(prefix) or 'settings'}: cannot be computed with ({error})"
        raise ConfigError(prefix, f"{reason}: {', '.join(map(dotted, _named(prefix, values)))}") from None
    except ValueError as error:
        defaults = {name: absent(field, base) for name, field in known.items()}
        raise _contradiction(str(error), prefix, {**defaults, **values}) from None


def _named(prefix: Key, values: Mapping[str, Any]) -> Iterator[Key]:
    return ((*prefix, name) for name, value in values.items() if not is_table(value))


def _first(key: Key, table: Any) -> str:
    """Return the key of a table's first setting as text."""
    return dotted((*key, next(settings(table)).name))


def _value(value: Any, hint: Any, key: Key, everywhere: list[Key]) -> Any:
    """Turn a plain value into the type of a field."""
    kind, optional = required(hint)
    if optional and value == UNSET:
        return None
    if isinstance(kind, type) and is_dataclass(kind) and isinstance(value, Mapping):
        return _table(kind, value, None, key, everywhere)
    if kind is Table and isinstance(value, Mapping):
        return _free_table(value, key)
    args = get_args(kind)
    if get_origin(kind) is Literal and any(value == arg and type(value) is type(arg) for arg in args):
        return value
    if get_origin(kind) is tuple and isinstance(value, list) and (args[-1] is ... or len(args) == len(value)):
        if table_of(hint) is not None:
            return tuple(_value(each, args[0], (*key, str(i)), everywhere) for i, each in enumerate(value))
        try:
            return tuple(_value(each, element(kind, i), key, everywhere) for i, each in enumerate(value))
        except ConfigError:
            raise refuse(key, value, f"expected {expected(hint)}") from None
    if kind is float and type(value) is int:
        return _as_float(value, key)
    if kind in (int, float, bool, str) and type(value) is kind:
        return value
    if kind is Path and type(value) is str:
        if not value:
            raise refuse(key, value, "must be the name of a file or folder; . is this folder")
        return Path(value)
    raise refuse(key, value, f"expected {expected(hint)}")


def _laid_over(before: Mapping[str, Any], value: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of any keys with other values laid over it; `none` takes a key away. - and _ are alike in keys."""
    found: dict[str, Any] = {}
    for name, each in (*before.items(), *value.items()):
        known = next((other for other in found if other.replace("-", "_") == name.replace("-", "_")), name)
        if each == UNSET:
            found.pop(known, None)
        elif isinstance(each, Mapping):
            inner = found.get(known)
            found[known] = _laid_over(inner if isinstance(inner, Mapping) else {}, each)
        else:
            found[known] = each
    return found


def _free_table(value: Mapping[str, Any], key: Key) -> Table:
    try:
        return Table(value)
    except ValueError as error:
        raise refuse(key, value, error) from None


def _as_float(value: int, key: Key) -> float:
    try:
        return float(value)
    except OverflowError:
        raise refuse(key, value, "is too large for a number") from None


def _contradiction(message: str, prefix: Key, values: Mapping[str, Any]) -> ConfigError:
    """Return the error of a class about its own settings, completed by the setting's full key and value."""
    where, colon, reason = message.partition(": ")
    names = tuple(where.split("."))
    if not colon or names[0] not in values:
        return ConfigError(prefix, ": ".join(filter(None, (dotted(prefix), message))))
    value = values[names[0]]
    for name in names[1:]:
        value = getattr(value, name)
    key = (*prefix, *names)
    if is_table(value) or (isinstance(value, tuple) and any(map(is_table, value))):
        return ConfigError(key, f"{dotted(key)}: {reason}")
    return refuse(key, UNSET if value is None else value, reason)


def _unknown(key: Key, names: Mapping[str, Field], everywhere: list[Key]) -> ConfigError:
    """Return the error for an unknown key. It suggests a similar key of this table, else of any table."""
    similar = [(*key[:-1], name) for name in difflib.get_close_matches(key[-1], names, 1)]
    if not similar:
        last_names = {each[-1]: each for each in reversed(everywhere)}
        similar = [last_names[name] for name in difflib.get_close_matches(key[-1], last_names, 1)]
    meant = f"did you mean {dotted(similar[0])}? " if similar else ""
    return ConfigError(key, f"unknown key {dotted(key)}: {meant}(keys: {', '.join(names)})")


def from_text(text: str, hint: Any, key: Key) -> Any:
    """Turn the text of a flag into the plain value that a file would hold: `0.5`, `64,64`, `none`, `[[1], [2]]`."""
    kind, optional = required(hint)
    if optional and text == UNSET:
        return text
    if kind is Table or kind is Any:
        return _plain_from_text(text, kind, key)
    if text[:1] in ("[", "{") and (get_origin(kind) is tuple or table_of(hint) is not None):
        import tomllib

        try:
            return tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            raise refuse(key, text, f"expected {expected(hint)}, as in a file") from None
    if get_origin(kind) is tuple:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        return [from_text(part, element(kind, min(i, len(get_args(kind)) - 1)), key) for i, part in enumerate(parts)]
    if get_origin(kind) is Literal:
        return next((arg for arg in get_args(kind) if str(arg) == text), text)
    if kind is bool and text.lower() in TRUTHS:
        return TRUTHS[text.lower()]
    if kind in (int, float) and not text.isascii():
        return text  # digits of other scripts: Python accepts them, a TOML file does not
    try:
        return {int: int, float: float}.get(kind, str)(text)
    except ValueError:
        return text  # of the wrong type: `build` refuses it and lists the possible values


def _plain_from_text(text: str, kind: Any, key: Key) -> Any:
    """Turn the text of a table of any keys, or of one of its values, into a plain value: as in TOML, or as in JSON.

    A value that is neither is a text. Raises ConfigError for a table that is neither.
    """
    import tomllib

    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        pass
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        if kind is Table:
            raise refuse(key, text, "expected a table, as in a file: {name = value, ...}") from None
        return text


TRUTHS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
