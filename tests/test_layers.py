"""Who may import whom; pyproject.toml holds the contracts between folders."""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path
from textwrap import dedent

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("league", "dashboards", "agents", "matchmaking", "arenas", "storage")
MOST = 12  # modules and folders of a folder
FORMER_NAMES = {f"arenas/{name}.py" for name in ("options", "about", "props", "hooks")}
IN_EVERY_GAME = {
    "settings", "rules", "match", "scripts", "observation", "observation_layout", "stages", "starts", "errors",
}  # fmt: skip


def run(*command: str | Path) -> str:
    """Run a command in the repository; fail with what it said."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def packages_imported(source: str) -> set[str]:
    """Return the top-level packages that a module names in import statements, however deep inside functions."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def modules(package: str) -> list[Path]:
    """Return the files of a package's modules, relative to the repository, without those kept for a former name."""
    files = [file.relative_to(ROOT) for file in (ROOT / package).rglob("*.py") if file.name != "__init__.py"]
    return sorted(file for file in files if file.as_posix() not in FORMER_NAMES)


def test_folders_import_only_downwards():
    assert "0 broken" in run(Path(sys.executable).with_name("lint-imports"))


def test_imports_are_found_wherever_they_stand():
    source = "import jax.numpy as jnp, os\ndef f():\n    from torch.utils import dlpack\n    from .torch import x"
    assert packages_imported(source) == {"jax", "os", "torch"}


def test_only_the_bridge_imports_both_jax_and_torch():
    files = [file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")]
    assert len(files) >= len(FOLDERS)
    both = [file.relative_to(ROOT) for file in files if {"jax", "torch"} <= packages_imported(file.read_text("utf-8"))]
    assert both == [Path("agents/bridge.py")]


@pytest.mark.parametrize("heavy", ["jax", "torch", "mujoco"])
def test_the_command_line_starts_without(heavy):
    loaded = run(sys.executable, "-c", "import league.commands.cli, sys; print(*sys.modules, sep='\\n')").splitlines()
    assert "league.commands.cli" in loaded
    assert heavy not in loaded


@pytest.mark.parametrize("heavy", ["jax", "torch", "mujoco", "gymnasium", "pettingzoo"])
def test_arenas_settings_load_without(heavy):
    text = "import arenas, sys; print(len(arenas.known()), *sys.modules, sep='\\n')"
    count, *loaded = run(sys.executable, "-c", text).splitlines()
    assert int(count) > 5
    assert heavy not in loaded


def test_learning_starts_without_torch_compile():
    """Its import takes seconds, and torch's own Adam would have it."""
    text = """
        import sys, torch
        from torch import nn
        from agents.learner.optimizer import Adam, step
        layer = nn.Linear(2, 2)
        before = layer.weight.detach().clone()
        gradient = [torch.ones_like(p) for p in layer.parameters()]
        step(Adam(layer, torch.tensor(0.1)), gradient, 1.0, torch.tensor(1.0))
        print(float((layer.weight - before).abs().max()), "torch._dynamo" in sys.modules)
    """
    moved, loaded = run(sys.executable, "-c", dedent(text)).split()
    assert float(moved) == pytest.approx(0.1, rel=1e-3)
    assert loaded == "False"


@pytest.mark.parametrize("package", FOLDERS)
def test_folders_are_small_enough_to_be_seen_at_once(package):
    entries: dict[str, set[str]] = {}
    for file in modules(package):
        parts = file.parts
        for depth in range(1, len(parts)):
            entries.setdefault("/".join(parts[:depth]), set()).add(parts[depth])
    assert {folder: sorted(names) for folder, names in entries.items() if len(names) > MOST} == {}


@pytest.mark.parametrize("package", FOLDERS)
def test_no_two_folders_of_a_package_have_modules_of_one_name(package):
    names = Counter(file.stem for file in modules(package))
    assert {name for name, count in names.items() if count > 1} - IN_EVERY_GAME == set()
