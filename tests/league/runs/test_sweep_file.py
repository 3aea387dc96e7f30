"""A sweep's file: its cells, the names of its runs, and what it may not hold."""

import pytest

from league.config.schema import ConfigError
from league.runs.sweeps import sweep_file
from league.runs.sweeps.sweep_file import Range, run_name

TEXT = """
arena.name = "rock-paper-scissors"
training.worlds = 64
budget.steps = 4096

[sweep]
name = "lr"
seeds = 2

[sweep.grid]
learner.lr = [1e-3, 0.25]
learner.architecture.hidden = [[8], [16, 16]]
"""


def read(folder, text):
    (folder / "grid.toml").write_text(text)
    return sweep_file.read(folder / "grid.toml")


def test_every_combination_is_run_with_every_seed(tmp_path):
    runs = read(tmp_path, TEXT).runs()
    assert [run.name for run in runs[:4]] == [
        "lr.lr-0.001.hidden-8.s1", "lr.lr-0.001.hidden-8.s2",
        "lr.lr-0.001.hidden-16-16.s1", "lr.lr-0.001.hidden-16-16.s2",
    ]  # fmt: skip
    assert len({run.name for run in runs}) == 8
    for run in runs:
        assert run.config.league == run.name
        assert run.config.seed == run.seed
        assert run.config.learner.lr == run.cell["learner.lr"]
        assert [*run.config.learner.architecture.hidden] == run.cell["learner.architecture.hidden"]
        assert run.config.training.worlds == 64


def test_seeds_and_name_have_sensible_defaults(tmp_path):
    found = read(tmp_path, "seed = 5\nbudget.steps = 1\n[sweep]\n")
    assert found.name == "grid"
    assert [run.name for run in found.runs()] == ["grid.s5"]


def test_a_long_name_is_a_digest_that_depends_on_the_cell_alone():
    cells = [{f"training.opponents.{'x' * 90}": value} for value in (1, 2)]
    names = [run_name("s", cell, 1) for cell in cells]
    assert names == [run_name("s", cell, 1) for cell in cells]
    assert names[0] != names[1]
    assert max(map(len, names)) < 20


def test_ranges_are_searched(tmp_path):
    axes = "{ low = 1e-4, high = 1e-2, log = true }\nlearner.epochs = { low = 1, high = 4 }"
    found = read(tmp_path, TEXT.replace("[1e-3, 0.25]", axes).replace("seeds = 2", "trials = 3"))
    assert found.ranges == {"learner.lr": Range(1e-4, 1e-2, True), "learner.epochs": Range(1, 4)}
    assert [*found.grid] == ["learner.architecture.hidden"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = 1", "grid.toml has no table [sweep]"),
        ("sweep = 3", "grid.toml has no table [sweep]"),
        ("[sweep]", "nothing ends the runs: give budget.steps"),
        ("[sweep]\nseeds = 0", "grid.toml:2: sweep.seeds = 0: expected their number, 1 to 1000, or a list"),
        ("[sweep]\nseeds = 'two'", 'sweep.seeds = "two": expected their number, 1 to 1000, or a list'),
        ("[sweep]\nseeds = [1, 1]", "grid.toml:2: sweep.seeds = [1, 1]: must be at least one, each once"),
        ("[sweep]\nseedss = 1", "grid.toml:2: unknown key seedss: did you mean seeds?"),
        ("[sweep]\ntrials = 3", "grid.toml:2: sweep.trials: nothing is searched"),
        ("budget.steps=1\n[sweep.grid]\nlearner.lr = [3.0]", "grid.toml:3: learner.lr = 3.0: must be between"),
        ("budget.steps=1\n[sweep.grid]\nlearner.lrr = [0.1]", "grid.toml:3: unknown key learner.lrr"),
        ("[sweep.grid]\nlearner.lr = 0.1", "grid.toml:2: sweep.grid.learner.lr = 0.1: expected a list of values"),
        ("[sweep.grid]\nlearner.lr = []", "grid.toml:2: sweep.grid.learner.lr: needs at least one value"),
        ("[sweep.grid]\nseed = [1, 2]", "grid.toml:2: sweep.grid.seed: give sweep.seeds"),
        ("[sweep.grid]\nlearner.lr = {low = 2.0, high = 1.0}", "grid.toml:2: sweep.grid.learner.lr: low must be below"),
        ("[sweep.grid]\nlearner.lr = {low = 0.1, high = 1.0}", "grid.toml:2: learner.lr is a range, which is searched"),
        ("budget.steps=1\n[sweep.grid]\nlearner.lr = [0.1, 0.1]", "two cells of the grid are the same run"),
    ],
)
def test_what_cannot_be_is_one_line_with_its_place(text, says, tmp_path):
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text).runs()
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
