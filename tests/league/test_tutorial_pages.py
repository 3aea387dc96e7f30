"""The commands and files of pages with tutorials, such as docs/hour.md, in their order, with less training."""

import os
import re
import runpy
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.arenas.robots.bot import mjcf
from tests.league.conftest import ROOT, call, said

STEP = re.compile(r"<!-- tutorial(?:: (\S+))? -->\n```(?:bash|python|toml)\n(.*?)```", re.DOTALL)
SHORTER = {
    "run": ("--rating.worlds", "8", "--steps", "1024", "--budget.rating_time", "0s"),
    "exploit": ("--budget", "1024", "--episodes", "16"),
    "rate": ("--episodes", "8"), "play": ("--episodes", "8"),
}  # fmt: skip
SMALLER = {
    "DECISIONS = 60_000": "DECISIONS = 256",
    "num_envs=64": "num_envs=8",
    "n_steps=64, batch_size=1024": "n_steps=16",
}


def steps(page: str) -> Iterator[tuple[str, str | list[str]]]:
    """Yield the files of a page with their text, and its commands as words, under the name of their program."""
    for file, text in STEP.findall((ROOT / "docs" / page).read_text("utf-8")):
        if file:
            yield file, text
            continue
        for line in text.splitlines():
            program, *words = shlex.split(line, comments=True)
            yield program, words


def robot() -> str:
    """A quadruped of twelve joints, as a Go1 has."""
    roll = r'<joint name="\1_roll" axis="1 0 0" range="-.8 .8" actuatorfrcrange="-20 20"/>\g<0>'
    return re.sub(r'<joint name="(\w\w)_hip"', roll, mjcf())


def shorter(words: list[str]) -> list[str]:
    """A command of the page with less to do."""
    for option in ("--for", "--budget", "--steps", "--budget.steps", "--budget.rating_time", "--episodes"):
        if option in words:
            del words[words.index(option) : words.index(option) + 2]
    if "--games" in words:
        words[words.index("--games") + 1] = "2"
    return [*words, *SHORTER.get(words[0], ())]


def league(words: list[str], capsys: pytest.CaptureFixture[str], folder: Path) -> str:
    """Run a command of a page; return its output."""
    if words[0] == "watch":  # draws a film, which has tests of its own
        return ""
    if words[0] == "run":  # starts processes
        done = call(*shorter(words), cwd=folder)
        assert done.returncode == 0, (words, done.stderr)
        return done.stdout
    code, out, err = said(capsys, *shorter(words))
    assert code == 0, (words, out, err)
    return out


def train(file: str) -> None:
    """Run the script of a page with less training."""
    code = Path(file).read_text()
    for long, short in SMALLER.items():
        assert long in code
        code = code.replace(long, short)
    Path(file).write_text(code)
    runpy.run_path(file, run_name="__main__")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder to work in."""
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # the commands set it for their own processes
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.timeout(1800)  # four programs of matches and learning, each compiled anew
def test_every_step_of_the_hour_runs_in_its_order(folder, capsys):
    out = ""
    for name, given in steps("hour.md"):
        match name, given:
            case "mkdir", _:
                (folder / "my").mkdir()
                (folder / "my" / "go1.xml").write_text(robot())
            case "league", ["robot", *_]:  # the stand-in as a file of one's own
                assert said(capsys, "robot", "my/go1.xml")[0] in (0, 1), "it may fall"
            case "league", list(words):
                out += league(words, capsys, folder)
            case "cp", [example, file]:
                shutil.copy(ROOT / example, folder / file)
            case "python", ["my/random_policy.py" as file]:
                runpy.run_path(file, run_name="__main__")
            case "python", [file]:
                train(file)
            case _, str(text):
                (folder / name).write_text(text)
    assert out.count("ok  ") == 27
    assert re.search(r"ppo against guest: \d+ won", out)


@pytest.mark.slow
def test_every_step_with_exploiters_runs_in_its_order(folder, capsys):
    out = ""
    for name, given in steps("exploiters.md"):
        if isinstance(given, list):
            out += league(given, capsys, folder)
        else:
            (folder / name).write_text(given)
    assert out.count("Exploitability of blue@") == 3
    assert "blue-exploiter" in out


def follow(page: str, capsys: pytest.CaptureFixture[str], folder: Path) -> str:
    """Write the files of a page and run its commands in their order; return the output of `league`."""
    out = ""
    for name, given in steps(page):
        match name, given:
            case "league", list(words):
                out += league(words, capsys, folder)
            case "python", [file]:
                runpy.run_path(file, run_name="__main__")
            case _, str(text):
                (folder / name).write_text(text)
            case _:
                pytest.fail(f"{page}: no test runs {name}")
    return out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of torch itself, where it exports with dynamo=False
@pytest.mark.timeout(900)  # matches of five programs, each compiled anew
def test_every_step_with_policies_of_ones_own_runs_in_its_order(folder, capsys):
    out = follow("policies.md", capsys, folder)
    assert {"strong.onnx", "strong.pt", "strong.safetensors.md", "network.onnx"} <= set(os.listdir(folder))
    assert re.search(r"sprinter against blue@\d+: \d+ won", out)
    assert re.search(r"mine against strong: \d+ won", out)


@pytest.mark.slow
def test_every_step_of_a_first_try_of_the_bench_runs_in_its_order(folder, capsys):
    (folder / "benchmarks").symlink_to(ROOT / "benchmarks")
    out = follow("bench.md", capsys, folder)
    assert re.search(r"kuhn\.safetensors\): exact exploitability 0\.\d+", out)
    assert "Wrote t1-sumo-rovers-v1-first.json." in out
