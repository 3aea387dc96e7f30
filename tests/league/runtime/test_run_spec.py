"""A configuration crosses process borders as one text, which a start writes once and each process parses once."""

import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from storage.store import Store
from tests.league.conftest import ENVIRONMENT, command

COUNTING = """
import os
from league.config import experiment

def counted(name):
    function = getattr(experiment, name)

    def wrapper(*args, **kwargs):
        import sys
        with open(os.environ["CALLS"], "a") as file:
            print(name, os.getpid(), sys._getframe(1).f_globals["__name__"], file=file)
        return function(*args, **kwargs)

    setattr(experiment, name, wrapper)

counted("dumps")
counted("loads")
"""
"""A module `sitecustomize`: Python imports it first in each process that is started."""
GAME = (
    "--arena.name", "rock-paper-scissors", "--league", "tiny", "--training.worlds", "64",
    "--training.rollout_length", "8",
    "--training.iterations_per_turn", "1", "--rating.trained", "false", "--workers.match", "0",
    "--budget.rating_time", "0s",
)  # fmt: skip


def calls(folder: Path, *more: str) -> tuple[Counter[str], Counter[tuple[str, str]]]:
    """Run a league: how often a configuration was written, by module, and how often parsed, by process and module."""
    (folder / "site").mkdir(exist_ok=True)
    (folder / "site" / "sitecustomize.py").write_text(COUNTING)
    found = folder / "calls.txt"
    found.write_text("")
    environment = {**ENVIRONMENT, "PYTHONPATH": str(folder / "site"), "CALLS": str(found)}
    subprocess.run(command("run", *GAME, *more), cwd=folder, env=environment, check=True, timeout=300)
    lines = [line.split() for line in found.read_text().splitlines()]
    written = Counter(module for name, _, module in lines if name == "dumps" and not module.endswith("turn_end"))
    return written, Counter((pid, module) for name, pid, module in lines if name == "loads")


@pytest.mark.parametrize(
    ("budget", "dumps"), [(("--for", "1s"), 2), pytest.param(("--steps", "512"), 1, marks=pytest.mark.slow)]
)
def test_a_start_writes_its_configuration_once_and_parses_it_once_in_each_process(budget, dumps, tmp_path):
    """`--for` counts from what the store holds, so the budget of this run is known only after the preflight."""
    written, parsed = calls(tmp_path, *budget)
    assert written == {"league.config.run_spec": dumps}
    assert {module for _, module in parsed} == {"league.config.run_spec"}
    assert len({pid for pid, _ in parsed}) == 1  # the process that has prepared the league and then trains
    assert parsed.total() == dumps
    with Store.open(tmp_path / "league-data") as store:
        (run,) = store.runs("tiny")
        assert run.config == store.league("tiny").config
        assert configuration.loads(run.config).league == "tiny"


def test_a_specification_has_the_sizes_of_its_run_and_a_text_that_leaves_them_open():
    config = configuration.default("rock-paper-scissors")
    assert (config.training.worlds, config.rating.worlds, config.rating.pairings) == (None, None, None)
    spec = RunSpec.of("store", config)
    assert spec.config() == config
    sized = replace(spec, worlds=64, rating_worlds=512, rating_pairings=4)
    found = sized.config()
    assert (found.training.worlds, found.rating.worlds, found.rating.pairings) == (64, 512, 4)
    assert sized.config_toml == spec.config_toml
    assert configuration.loads(sized.config_toml) == config
