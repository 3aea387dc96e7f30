"""Former names of settings, which files, flags and stored configurations may still use.

A field says in its metadata how it was called before: `metadata={"formerly": "rollout"}`. Where a person writes that
name it is accepted for one release, with a line on stderr; what is stored may have it for ever. A list whose values are
names of settings has them in its metadata, by their present names: `metadata={"values_formerly": {"gamma": "g"}}`.
"""

from collections.abc import Mapping
from dataclasses import Field
from typing import Any

from league.config.schema import (
    ConfigError,
    Key,
    dotted,
    hints,
    inner_table,
    key_of,
    literal,
    removed,
    settings,
    table_of,
)

Former = dict[Key, Key]
"""The keys that were given by a former name: present key -> key as it was given. The key of a value in a list ends with
the value in quotes."""


def field_named(cls: Any, name: str) -> Field | None:
    """Return the setting of a class that has, or formerly had, that name."""
    return next((each for each in settings(cls) if name in (key_of(each), each.metadata.get("formerly"))), None)


def present_names(table: Mapping[str, Any], cls: type, base: Any = None, at: Key = ()) -> tuple[dict[str, Any], Former]:
    """Return a plain table with the present names of all settings, and the keys that were given by former names.

    `base` is as for `build`, and `at` is the table's own key; settings that were removed are left out, and unknown keys
    stay as they are. Raises ConfigError if a setting is given by both names.
    """
    former: Former = {}
    return _table(table, cls, base, (at, at), former), former


def _table(table: Mapping[str, Any], cls: type, base: Any, keys: tuple[Key, Key], former: Former) -> dict[str, Any]:
    """Return a table with present names, and add to `former`; `keys` are its own, by present names and as given."""
    found = {}
    for name, value in table.items():
        if removed(cls, name):
            continue
        field = field_named(cls, name)
        kind, default = (None, None) if field is None else inner_table(cls, field, base)
        key, given = (*keys[0], name if field is None else key_of(field)), (*keys[1], name)
        if key[-1] != name:
            if key[-1] in table:
                raise ConfigError(given, f"{dotted(given)} is now {dotted(key)}: give only {dotted(key)}")
            former[key] = given
        if field is not None and "values_formerly" in field.metadata:
            found[key[-1]] = _values(value, field.metadata["values_formerly"], (key, given), former)
        else:
            found[key[-1]] = value if kind is None else _value(value, kind, default, (key, given), former)
    return found


def _values(values: Any, names: Mapping[str, str], keys: tuple[Key, Key], former: Former) -> Any:
    """Return a list of names with the present ones, and add to `former`; anything else stays as it is."""
    if not isinstance(values, list):
        return values
    present = {was: now for now, was in names.items()}
    found = [present.get(each, each) if isinstance(each, str) else each for each in values]
    for now, was in zip(found, values, strict=True):
        if now != was:
            former[(*keys[0], literal(now))] = (*keys[1], literal(was))
    return found


def _value(value: Any, kind: type, default: Any, keys: tuple[Key, Key], former: Former) -> Any:
    if isinstance(value, Mapping):
        return _table(value, kind, default, keys, former)
    if isinstance(value, list):
        return [
            _value(each, kind, None, ((*keys[0], str(i)), (*keys[1], str(i))), former) for i, each in enumerate(value)
        ]
    return value


def value_at(table: Any, key: Key, cls: Any) -> Any:
    """Return the value of a setting in a plain table of a class, where key and table may each use a former name.

    Raises KeyError if the table lacks it, TypeError if something else than a table is on the way.
    """
    for name in key:
        field = None if cls is None else field_named(cls, name)
        names = (name,) if field is None else (key_of(field), field.metadata.get("formerly", name))
        table = table[next((each for each in names if each in table), name)]
        cls = None if field is None else table_of(hints(cls)[field.name])
    return table


def deprecation(former: Former) -> str:
    """Return one line for a person about the former names that were given."""
    renamed = ", ".join(_renamed(key, given) for key, given in former.items())
    return f"deprecated, accepted until the next release: {renamed}"


def _renamed(key: Key, given: Key) -> str:
    if given[-1].startswith('"'):  # a value in a list
        return f"{given[-1]} in {dotted(given[:-1])} is now {key[-1]}"
    return f"{dotted(given)} is now {dotted(key)}"
