"""More classes of bad input, drawn as in `tests/faults/hostile.py`: types, headers, names of outputs, foreign names.

Outputs of these cases have various encodings; some targets have no space or no reader.
"""

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from league.commands.cli import COMMANDS
from league.config import experiment as configuration
from league.config import flags
from league.snapshots.policy_file import KEY
from tests.faults.hostile import FILES, Case, put, value

OUTPUTS: Mapping[str, tuple[str, ...]] = {
    "pack": ("pack", "{}", "--store", "store"),
    "export": ("export", "blue@1", "-o", "{}", "--store", "store"),
    "card": ("export", "blue@1", "-o", "new.safetensors", "--card", "{}", "--store", "store"),
    "report": ("report", "-o", "{}", "--store", "store"),
    "init": ("init", "{}"),
    "log": ("log", "--tensorboard", "{}", "--store", "store"),
    "watch --save": ("watch", "--save", "{}", "--store", "store"),
    "watch --shot": ("watch", "--shot", "{}", "--store", "store"),
    "watch --video": ("watch", "--video", "{}", "--store", "store"),
    "export-match": ("export-match", "1", "--foxglove", "-o", "{}", "--store", "store"),
    "unpack": ("unpack", FILES["zip"], "--store", "{}"),
    "run": ("run", "--store", "{}", "--help"),
}
"""Commands that write; {} stands for the name of their output."""
ENDINGS = (
    "",
    ".zip",
    ".rrd",
    ".png",
    ".mp4",
    ".gif",
    ".webp",
    ".mcap",
    ".html",
    ".safetensors",
    ".md",
    "/",
    "/.",
    "/..",
)
NAMES = (
    *(
        "",
        ".",
        "..",
        "...",
        "/",
        "//",
        " ",
        "\n",
        "\r",
        "\t",
        "~",
        "-",
        "--",
        "-o",
        "*",
        "\udcff",
        "\udcff\udcfe",
        "nul",
    ),
    *("a" * 255, "a" * 256, "a" * 300, "ä" * 128, "東" * 86, "😀" * 64, "a/" * 2000 + "a", "/dev/null", "/dev/full"),
    *("store", "store/league.db", "store/blobs", "league.toml", "cup.zip", "missing/folder/x", "league.toml/x"),
    *("\x1b[2J", "a\x1b]0;x\x07", "\u202ecod", "=1+1", "@x", "-x", "+x", "x\u0000"[:1], "%s", "$HOME", "`id`"),
)
FOREIGN = (
    *("\x1b[2J", "\x1b]0;x\x07", "\x9b2J", "\u202e", "\u2066", "\u200b", "\r", "\x07", "\x00"[:0], "\x7f", "\ufeff"),
    *("=cmd|' /C calc'!A0", "@SUM(A1)", "+1+1", "-1-1", "\t=1", "Łódź", "東京", "😀", "e\u0301", "\u00a0", "\u2028"),
)
TYPED = (
    *(
        "0",
        "0.0",
        "-0.0",
        "-1",
        "1e-320",
        "1e300",
        "inf",
        "nan",
        "9223372036854775808",
        "true",
        '""',
        '"x"',
        "[]",
        "[0]",
    ),
    *("[[]]", "[1, 2, 3]", "{}", "{x = 1}", '["a", "b"]', "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", '"none"'),
    *('"none"', '"sumo-1v1"', "['']", "[[1, 2], [3, 4]]", f'"{"a" * 20_000}"', f"[{'64, ' * 2_000}]"),
)
ENCODINGS = ("utf-8", "utf-8", "latin-1", "ascii", "cp1252", "koi8-r")

json_value = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.sampled_from(FOREIGN)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
    max_leaves=6,
)


@st.composite
def types(draw: st.DrawFn, kept: Path) -> Case:
    """Draw settings with values of other types or in wrong tables, in a file or as flags."""
    base = configuration.default(draw(st.sampled_from(("sumo-2v2", "sumo-1v1", "soccer-1v1", "block-push-anymal"))))
    keys = [".".join(key) for key in flags.every(configuration.Config, base)]
    tables = sorted({key.rpartition(".")[0] for key in keys} - {""})
    name = draw(
        st.sampled_from([*keys, *tables, "players", "stages", "roles", *(key.rpartition(".")[2] for key in keys)])
    )
    typed = draw(st.sampled_from(TYPED))
    encoding = draw(st.sampled_from(ENCODINGS))
    if draw(st.integers(0, 2)):
        lines = [f"{name} = {typed}", f'arena.name = "{base.arena.name}"']
        text = "\n".join(lines if draw(st.booleans()) else [f"[{name}]\nx = {typed}"])
        return Case(
            ("run", FILES["toml"], "--store", "new", "--help"), put(FILES["toml"], text.encode()), text, encoding
        )
    args = ("run", f"--arena.name={base.arena.name}", f"--{name}={typed.strip(chr(34))}", "--store", "new", "--help")
    return Case(args, None, "", encoding)


@st.composite
def headers(draw: st.DrawFn, kept: Path) -> Case:
    """Draw policy files that are complete but have a changed header."""
    data = (kept / FILES["policy"]).read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    policy = json.loads(header["__metadata__"][KEY])
    match draw(st.sampled_from(("policy", "policy", "metadata", "tensor", "header"))):
        case "policy":
            for _ in range(draw(st.integers(1, 2))):
                policy = _changed(draw, policy)
            header["__metadata__"] = {KEY: json.dumps(policy)}
        case "metadata":
            other = st.one_of(json_value, st.dictionaries(st.just(KEY), json_value, min_size=1))
            header["__metadata__"] = draw(other)
        case "tensor":
            name = draw(st.sampled_from(sorted(header.keys() - {"__metadata__"})))
            header[name] = _changed(draw, header[name])
        case "header":
            header = _changed(draw, header)
    text = json.dumps(header).encode()
    named = draw(st.one_of(st.just("strange"), st.sampled_from(NAMES), st.sampled_from(FOREIGN)))
    harm = put(FILES["policy"], struct.pack("<Q", len(text)) + text + data[8 + size :])
    args = ("import", FILES["policy"], f"--as={named}", "--store", "store")
    return Case(args, harm, repr(text)[:300], draw(st.sampled_from(ENCODINGS)))


def _changed(draw: st.DrawFn, given: dict[str, Any]) -> dict[str, Any]:
    """Draw the object with one value replaced, removed, or wrapped in something else."""
    if not given:
        return {"x": draw(json_value)}
    name = draw(st.sampled_from(sorted(given)))
    change = draw(st.sampled_from(("other", "gone", "in a list", "as text")))
    if change == "gone":
        return {key: each for key, each in given.items() if key != name}
    other = {"in a list": [given[name]], "as text": json.dumps(given[name])}.get(change)
    return {**given, name: draw(json_value) if other is None else other}


@st.composite
def outputs(draw: st.DrawFn, kept: Path) -> Case:
    """Draw names of output files and folders, for every command that writes."""
    name = draw(st.one_of(st.sampled_from(NAMES), st.text(max_size=8), value)) + draw(st.sampled_from(ENDINGS))
    args = OUTPUTS[draw(st.sampled_from(sorted(OUTPUTS)))]
    name = "".join(c for c in name if c != "\0" and not 0xD800 <= ord(c) < 0xDC80)
    # Nothing may be written outside of the case's folder, whatever the name is.
    name = name if name.startswith("/dev/") else name.lstrip("/").replace("..", "dots")
    return Case(tuple(name if arg == "{}" else arg for arg in args), None, "", draw(st.sampled_from(ENCODINGS)))


@st.composite
def names(draw: st.DrawFn, kept: Path) -> Case:
    """Draw match and payoff files with player names that a terminal or a spreadsheet would execute."""
    part = st.one_of(st.sampled_from(FOREIGN), st.text(st.characters(exclude_categories=["Cs"]), max_size=4))
    called = [f"{draw(part)}{i}{draw(part)}".replace('"', "").replace("\0", "") for i in range(4)]
    cells = [f'"{name}"' for name in called]
    format = draw(st.sampled_from(("table", "csv", "json")))
    if draw(st.booleans()):
        rows = [f"ring,{cells[i]},{cells[(i + 1) % 4]},{i + 1},1,2" for i in range(4)]
        data = "\n".join(["arena,side_a,side_b,wins_a,draws,wins_b", *rows])
        args = ("rate", FILES["csv"], "--format", format)
        return Case(args, put(FILES["csv"], data.encode()), repr(data)[-300:], draw(st.sampled_from(ENCODINGS)))
    rows = [",".join(str((i - j) % 4 - 1.5) for j in range(4)) for i in range(4)]
    data = "\n".join([",".join(cells), *rows])
    args = ("meta", FILES["matrix"], "--format", format)
    return Case(args, put(FILES["matrix"], data.encode()), repr(data)[-300:], draw(st.sampled_from(ENCODINGS)))


@st.composite
def lines(draw: st.DrawFn, kept: Path) -> Case:
    """Draw any command with options, bad values, and --help at the end, so that nothing is begun."""
    name = draw(st.sampled_from(sorted(COMMANDS)))
    given = [draw(st.one_of(value, st.sampled_from(NAMES), st.sampled_from(FOREIGN))) for _ in range(2)]
    flag = draw(
        st.sampled_from(("store", "league", "format", "port", "last", "for", "match", "output", "arena", "x.y"))
    )
    args = (name, f"--{flag}", *given, "--help")
    return Case(tuple(arg.replace("\0", "") for arg in args), None, "", draw(st.sampled_from(ENCODINGS)))


CLASSES: Mapping[str, Callable[[Path], st.SearchStrategy[Case]]] = {
    "types": types, "policy headers": headers, "outputs": outputs, "foreign names": names, "command lines": lines,
}  # fmt: skip
