"""The folder `agents`, whose name other packages have too: the OpenAI Agents SDK, and many people's own projects.

Ours is a namespace package, a folder without an `__init__.py`. As an installed package it lies in one folder with the
SDK's files, in either order of installation, and `import agents` is the SDK's. From a checkout, Python takes another's
`agents` before ours. In both cases our modules are found by the names below, and all others by Python's own rules.
"""

import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

NAME = "agents"
FOLDER = Path(__file__).resolve().parents[3] / NAME
MODULES = ("batch", "bridge", "devices", "errors", "learner", "policy", "rollout", "settings")
"""Modules and folders of ours in it."""


class AgentsFinder:
    """A finder on `sys.meta_path` for our modules of `agents`, whatever package Python has found under that name."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: object = None) -> ModuleSpec | None:
        """Return the spec of one of our modules `agents.*`, None for any other module.

        Raises ImportError if the other package `agents` has a module of that name too.
        """
        package, _, module = name.partition(".")
        if package != NAME or module not in MODULES:
            return None
        ours = PathFinder.find_spec(name, [str(FOLDER)])
        theirs = PathFinder.find_spec(name, path) if getattr(sys.modules.get(NAME), "__file__", None) else None
        if ours and theirs and theirs.origin != ours.origin:
            raise ImportError(
                f"{name} is both {theirs.origin} and Robot League's {ours.origin}: rename that folder or module"
            )
        return ours


def share() -> None:
    """Let our modules of `agents` be imported beside those of another package of that name."""
    if AgentsFinder not in sys.meta_path:
        sys.meta_path.insert(0, AgentsFinder)


def sources() -> Iterator[Path]:
    """Yield our files of Python code in the folder, in which another distribution's may lie too."""
    for module in MODULES:
        yield from (FOLDER / module).rglob("*.py") if (FOLDER / module).is_dir() else [FOLDER / f"{module}.py"]


def is_installed(package: Path) -> bool:
    """Return True if a package, given as its `__init__.py`, lies where distributions are installed."""
    return any(package.parents[1].glob("*.dist-info"))


def clashes(package: Path) -> list[str]:
    """Return names of ours that another package `agents` has too, or has overwritten where it lies in our folder."""
    if package.parent != FOLDER:
        return sorted(f"{NAME}.{path.stem}" for path in package.parent.iterdir() if path.stem in MODULES)
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        files = distribution("robot-league").files or ()
    except PackageNotFoundError:
        return []
    ours = (file for file in files if file.parts[0] == NAME and file.suffix == ".py" and file.size is not None)
    return sorted(str(file) for file in ours if Path(str(file.locate())).stat().st_size != file.size)
