import math
import tomllib
from dataclasses import dataclass, field, replace
from typing import Literal

import pytest

from league.config.durations import seconds
from league.config.schema import ConfigError, check
from league.config.toml import dumps, key_lines, loads


@dataclass(frozen=True)
class Network:
    """The actor's layers.

    The rest of a docstring stays in the code.
    """

    widths: tuple[int, ...] = (64, 64)
    """Units of each hidden layer."""
    gain: float | None = 0.01


@dataclass(frozen=True)
class Sumo:
    """Push the others out of the ring."""

    radius: float = field(default=2.0, metadata={"above": 0, "high": 10})
    """Radius of the ring, in metres."""
    spread: tuple[float, float] = field(default=(0.2, 0.8), metadata={"low": 0, "high": 1})


@dataclass(frozen=True)
class Galaga:
    waves: int = 3


@dataclass(frozen=True)
class Learner:
    """How a team learns."""

    lr: float = 5e-4
    """Learning rate.
    Adam's, in the first iteration."""
    minibatches: int = 4
    batch: int = 64
    optimiser: Literal["adam", "sgd"] = "adam"
    network: Network = Network(gain=None)

    def __post_init__(self):
        if self.batch % self.minibatches:
            raise ValueError(f"batch: must be a multiple of minibatches ({self.minibatches})")
        if self.optimiser == "sgd" and self.network.gain:
            raise ValueError("sgd wants no gain")


@dataclass(frozen=True)
class Seat:
    """One of a crew."""

    name: str
    """Its name."""
    at: tuple[int, int] = field(default=(0, 0), metadata={"low": 0})
    network: Network = Network()


@dataclass(frozen=True)
class Experiment:
    seed: int = 0
    name: str | None = None
    deterministic: bool = False
    every: str = field(default="5m", metadata={"valid": seconds})
    opponent: str | None = "latest"
    arena: Sumo | Galaga = Sumo()
    learner: Learner = Learner()
    best: Learner | None = None
    crew: tuple[Seat, ...] = ()
    crews: tuple[Seat, ...] = (Seat("x"),)


@dataclass(frozen=True)
class Named:
    title: str


def error(text, cls: type = Experiment, **options):
    with pytest.raises(ConfigError) as caught:
        loads(text, cls, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_file_explains_every_setting():
    assert dumps(Learner(network=Network(gain=None))) == (
        "# How a team learns.\n\n"
        "# Learning rate.\n# Adam's, in the first iteration.\nlr = 0.0005\n\n"
        "minibatches = 4\n\n"
        "batch = 64\n\n"
        '# one of: "adam", "sgd"\noptimiser = "adam"\n\n'
        "# The actor's layers.\n[network]\n\n"
        "# Units of each hidden layer.\nwidths = [64, 64]\n\n"
        "# gain =  (unset)\n"
    )


def test_bounds_are_part_of_the_explanation():
    text = dumps(Sumo(radius=3))
    assert "# Radius of the ring, in metres.\n# above 0 and at most 10\nradius = 3.0\n" in text
    assert "# between 0 and 1\nspread = [0.2, 0.8]\n" in text


def test_deeper_tables_carry_their_whole_name():
    assert "\n[learner.network]\n" in dumps(Experiment())


@pytest.mark.parametrize(
    "config",
    [
        Experiment(),
        Experiment(seed=-(2**62), deterministic=True, opponent=None, name='quoted "é" \\ \x7f \t\n#[x]'),
        Experiment(name="", learner=Learner(lr=math.pi * 1e-300, network=Network((), gain=0.1 + 0.2))),
        Experiment(best=Learner(optimiser="sgd", lr=1e-22, network=Network((1,), gain=None))),
        Experiment(learner=Learner(lr=5e-324), crew=(Seat("a"), Seat("b", (1, 2), Network(gain=None))), crews=()),
        Experiment(arena=Sumo(radius=math.nextafter(2, 3), spread=(0, 1))),
    ],
)
def test_reading_what_was_written_gives_an_equal_config(config):
    assert loads(dumps(config), Experiment) == config


def test_a_missing_key_is_as_in_the_base_else_the_default():
    base = Experiment(seed=7, learner=Learner(lr=0.1, network=Network((8,))))
    read = loads("[learner]\nbatch = 32", Experiment, base=base)
    assert read == replace(base, learner=replace(base.learner, batch=32))
    assert loads("[learner]\nbatch = 32", Experiment) == Experiment(learner=Learner(batch=32))


def test_a_default_of_the_outer_class_holds_within_its_table():
    assert loads("[learner.network]\nwidths = []", Experiment).learner.network == Network((), gain=None)


def test_the_base_chooses_the_class_of_a_table():
    base = Experiment(arena=Galaga())
    assert loads(dumps(replace(base, arena=Galaga(4))), Experiment, base=base) == replace(base, arena=Galaga(4))
    assert loads("arena.waves = 5", Experiment, base=base).arena == Galaga(5)
    assert "unknown key arena.radius: (keys: waves)" in error("arena.radius = 5", base=base)


def test_none_unsets_what_may_be_unset():
    assert loads('opponent = "none"', Experiment).opponent is None
    assert loads('best = "none"', Experiment, base=Experiment(best=Learner())).best is None
    with pytest.raises(ConfigError, match='opponent = "none": the word means that there is no value'):
        dumps(Experiment(opponent="none"))


def test_what_is_unset_stays_so_where_the_base_has_a_value():
    base = Experiment(opponent="past", best=Learner())
    written = dumps(replace(base, opponent=None), base)
    assert 'opponent = "none"' in written
    assert loads(written, Experiment, base=base) == replace(base, opponent=None)


def test_an_int_is_a_float_but_a_bool_is_no_number():
    read = loads("lr = 1", Learner)
    assert type(read.lr) is float
    assert error("lr = true", Learner) == "league.toml:1: lr = true: expected a number"
    assert error("batch = true", Learner) == "league.toml:1: batch = true: expected a whole number"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[learner]\nlr = "fast"', '2: learner.lr = "fast": expected a number'),
        ("batch = 4\n\nseed = 1.5", "1: unknown key batch: did you mean learner.batch? "),
        ("seed = 1.5", "1: seed = 1.5: expected a whole number"),
        ("deterministic = 1", "1: deterministic = 1: expected true or false"),
        ("opponent = 3", '1: opponent = 3: expected text in quotes, or "none"'),
        ("# a = 1\n[arena]\nspread = [0.1]", "3: arena.spread = [0.1]: expected [a number, a number]"),
        (
            "learner.network.widths = [1, 'x']",
            '1: learner.network.widths = [1, "x"]: expected a list, each a whole number',
        ),
        ("learner.optimiser = 'lion'", '1: learner.optimiser = "lion": expected one of "adam", "sgd"'),
        ("learner = 3", "1: learner = 3: expected a table"),
        ("[seed]\na = 1", "1: seed = {a = 1}: expected a whole number"),
        ("[[learner]]\nlr = 1", "1: learner = [{lr = 1}]: expected a table"),
        ("seed = 1979-05-27", "1: seed = 1979-05-27: expected a whole number"),
        ("\n[arena]\nradius = 0", "3: arena.radius = 0.0: must be above 0 and at most 10"),
        ("\n[arena]\nradius = nan", "3: arena.radius = nan: must be finite"),
        ("[arena]\nspread = [0, 1.5]", "2: arena.spread = [0.0, 1.5]: must be between 0 and 1"),
        ("every = 'soon'", '1: every = "soon": "soon" is not a duration'),
        ("[learner]\nlr = 1\nbatch = 63", "3: learner.batch = 63: must be a multiple of minibatches (4)"),
        ("[learner]\nminibatches = 7", "1: learner.batch = 64: must be a multiple of minibatches (7)"),
        ("[learner]\nlr = inf", "2: learner.lr = inf: must be finite"),
        ("[learner]\nlr = nan", "2: learner.lr = nan: must be finite"),
        ("[[crew]]\nname = 'a'\n[[crew]]\nname = 'b'\nat = [1]", "5: crew[1].at = [1]: expected [a whole number, "),
        ("[[crew]]\nname = 'a'\n\n[[crew]]\nname = 'b'\nat = [1, -1]", "6: crew[1].at = [1, -1]: must be at least 0"),
        ("[[crew]]\nname = 'a'\n[[crew]]\nnaem = 'b'", "4: unknown key crew[1].naem: did you mean crew[1].name?"),
        ("[[crew]]\nat = [1, 2]", "1: crew[0].name is missing: expected text in quotes"),
        ("crew = [{name = 'a'},\n  {name = 3}]", "2: crew[1].name = 3: expected text in quotes"),
        ("[crew]\nname = 'a'", '1: crew = {name = "a"}: expected a list, each a table'),
        ("seed = 1\n[learner]\noptimiser = 'sgd'\nnetwork.gain = 1", "2: learner: sgd wants no gain"),
    ],
)
def test_a_wrong_value_is_told_by_line_key_value_and_what_is_possible(text, message):
    assert error(text).startswith(f"league.toml:{message}")


def test_an_unknown_key_is_told_with_the_likely_one_and_all_possible_ones():
    assert error("[arena]\nradius = 1\nradiuss = 2", source="my.toml") == (
        "my.toml:3: unknown key arena.radiuss: did you mean arena.radius? (keys: radius, spread)"
    )
    assert "unknown key lerner: did you mean learner?" in error("[lerner]\nlr = 1")
    assert "unknown key arena.width: did you mean learner.network.widths?" in error("arena.width = []")
    assert "unknown key zzz: (keys: seed, name," in error("zzz = 1")


def test_a_setting_without_default_must_be_given():
    assert error("", Named) == "league.toml: title is missing: expected text in quotes"
    assert loads("title = 'x'", Named) == Named("x") == loads("", Named, base=Named("x"))


def test_a_value_of_the_base_is_refused_without_a_line():
    assert error("seed = 3", base=Experiment(arena=Sumo(radius=11))).startswith(
        "league.toml: arena.radius = 11: must be"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = 1\nname = \n", "2: not TOML: Invalid value (column 8)"),
        (f"seed = {'9' * 10_000}", "1: not TOML: too many digits, or brackets within brackets"),
        ("seed = 1\nseed = 2", "2: not TOML: Cannot overwrite a value"),
        ('seed = 1\nname = """x', "2: not TOML: Unterminated string"),
    ],
)
def test_what_is_not_toml_is_told_by_line(text, message):
    assert error(text).startswith(f"league.toml:{message}")


def test_where_an_arenas_file_is_given_its_flag_is_told():
    with pytest.raises(
        ConfigError, match=r"my/dash\.py:1: not TOML: .*; an arena in this file is named by --arena\.name"
    ):
        loads("from dataclasses import dataclass", Experiment, "my/dash.py")


def test_flags_are_checked_as_a_file_is():
    check(Experiment())
    with pytest.raises(ConfigError, match=r"^arena.radius = -1: must be above 0 and at most 10$"):
        check(Experiment(arena=Sumo(radius=-1)))
    with pytest.raises(ConfigError, match=r'^every = "5 years": "5 years" is not a duration'):
        check(Experiment(every="5 years"))


def test_a_class_of_no_supported_type_is_the_programmers_mistake():
    @dataclass(frozen=True)
    class Either:
        both: int | str = 3

    with pytest.raises(TypeError, match=r"cannot be of type int \| str"):
        loads("both = 3", Either)


def test_every_key_is_found_on_its_line():
    text = '''# a = 0
a = "b = 1 # [c]"  # d = 2
text = """
no = 1
[no]
"""""
raw = \'\'\'
no = "1\'\'\'
list = [
  1, # no = 3
  "no = 4",
  [ { in_list = 1 }, ],
]
inline = { x = 1, y.z = { deep = [ 1, 2 ] }, "q.r" = 3 }

[table]
key = 2024-01-01T00:00:00Z
"quoted ] key" = 1
 dotted . "k" .j = -1.5e3
[ other . 'table=' ]
key = 'C:\\'
[[many]]
one = true
[many.inner]
deep = 1
[[many]]
last = true
inner.deep = [[], {x = 1}, {x = 2, y = []}]
'''
    tomllib.loads(text)
    assert key_lines(text) == {
        ("a",): 2,
        ("text",): 3,
        ("raw",): 7,
        ("list",): 9,
        ("list", "2"): 12,
        ("list", "2", "0"): 12,
        ("list", "2", "0", "in_list"): 12,
        ("inline",): 14,
        ("inline", "x"): 14,
        ("inline", "y"): 14,
        ("inline", "y", "z"): 14,
        ("inline", "y", "z", "deep"): 14,
        ("inline", "q.r"): 14,
        ("table",): 16,
        ("table", "key"): 17,
        ("table", "quoted ] key"): 18,
        ("table", "dotted"): 19,
        ("table", "dotted", "k"): 19,
        ("table", "dotted", "k", "j"): 19,
        ("other",): 20,
        ("other", "table="): 20,
        ("other", "table=", "key"): 21,
        ("many",): 22,
        ("many", "0"): 22,
        ("many", "0", "one"): 23,
        ("many", "0", "inner"): 24,
        ("many", "0", "inner", "deep"): 25,
        ("many", "1"): 26,
        ("many", "1", "last"): 27,
        ("many", "1", "inner"): 28,
        ("many", "1", "inner", "deep"): 28,
        ("many", "1", "inner", "deep", "1"): 28,
        ("many", "1", "inner", "deep", "1", "x"): 28,
        ("many", "1", "inner", "deep", "2"): 28,
        ("many", "1", "inner", "deep", "2", "x"): 28,
        ("many", "1", "inner", "deep", "2", "y"): 28,
    }


def test_a_file_may_begin_with_a_byte_order_mark_and_must_be_utf_8(tmp_path):
    from league.config.experiment import load

    file = tmp_path / "league.toml"
    file.write_bytes("seed = 7\r\n[rating]\r\nepisodes_per_pair = 99\r\n".encode("utf-8-sig"))
    assert (load(file).seed, load(file).rating.episodes_per_pair) == (7, 99)
    file.write_bytes("seed = 7\r\nseat = 1\r\n".encode("utf-8-sig"))
    with pytest.raises(ConfigError, match=r"league.toml:2: .*seat"):
        load(file)
    file.write_bytes("seed = 7\n# Málaga\n".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"league.toml is not text in UTF-8: .* in line 2"):
        load(file)
    file.write_bytes("seed = 7\n".encode("utf-16"))
    with pytest.raises(ConfigError, match=r"league.toml is text in UTF-16, not in UTF-8: save it as UTF-8"):
        load(file)
