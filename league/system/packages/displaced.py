"""Packages of others in the place of ours: named in one line before anything is imported from them."""

from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

from league.system.packages import agents_folder
from league.system.provenance import PACKAGES, ROOT

OWN_NAME = "Robot League"  # in the first line of each of our packages that has an `__init__.py`


def displaced_package() -> str:
    """Return a line about one of our packages in whose place Python imports another's; empty if all can be imported.

    A folder `agents` or a file `storage.py` displaces ours if it comes first on the import path; a distribution that
    has a package of the same name overwrites our files. An installed package `agents`, as the OpenAI Agents SDK has,
    may stand beside ours as long as no module in it has the name of one of ours.
    """
    for package in PACKAGES:
        spec = find_spec(package)
        if package == agents_folder.NAME:
            if problem := _displaced_agents(spec):
                return problem
            continue
        places = [] if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
        found = next((Path(place) for place in places if place), None)
        if found is None:
            return _missing(package)
        if found != ROOT / package / "__init__.py":
            return _displaced(package, found)
        if OWN_NAME not in found.read_text(errors="replace")[:100]:
            return _shared(package, f"overwritten {found}")
    return ""


def _displaced_agents(spec: ModuleSpec | None) -> str:
    """Return a line about what Python imports as `agents`; empty if our modules of it can be imported."""
    if spec is None:
        return _missing(agents_folder.NAME)
    if spec.origin is None:  # our folder, and perhaps others that have no `__init__.py` either
        return ""
    found = Path(spec.origin)
    if found.name != "__init__.py" or not agents_folder.is_installed(found):
        return _displaced(agents_folder.NAME, found)
    if clashing := agents_folder.clashes(found):
        return _shared(agents_folder.NAME, f"modules of its own for Robot League's {', '.join(clashing)}")
    return ""


def _missing(package: str) -> str:
    return f"Robot League's package {package} is missing: install robot-league again"


def _displaced(package: str, found: Path) -> str:
    return (
        f"Python imports {package} from {found}, not from Robot League in {ROOT}: type `league` instead of"
        " `python -m league`, leave that folder out of PYTHONPATH, or rename it"
    )


def _shared(package: str, has: str) -> str:
    return (
        f"another distribution{_owners(package)} has {has}: two packages named {package} cannot"
        " share an environment, so install robot-league in one of its own (python -m venv)"
    )


def _owners(package: str) -> str:
    """Return the distributions that have a top-level package of this name, in parentheses; empty if unknown."""
    from importlib.metadata import packages_distributions

    others = sorted(set(packages_distributions().get(package, ())) - {"robot-league"})
    return f" ({', '.join(others)})" if others else ""
