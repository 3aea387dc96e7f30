"""The references of Robot League Bench: add policies to a task, play its references against each other, rate them.

    python -m scripts.bench_references t1-sumo-rovers-v1 --add blue@16.safetensors --name happo-middle --stage middle
    python -m scripts.bench_references t3-soccer-1v1-v1 --add anymal-soccer --kind shipped --team blue --words "..."
    python -m scripts.bench_references t1-sumo-rovers-v1 --play 256   # plays pairs whose games are missing
    python -m scripts.bench_references t1-sumo-rovers-v1              # prints their ratings

A change of a task's references changes their digest. Where references are only added, the manifest keeps the digest and
the names of the former set if an entry in benchmarks/entries met it, so that the entry stays in the table with what it
met. An entry has to be played again where a reference that it met has changed. A shipped policy that is about to be
replaced is first added as a learnt one, a file of the bench, if it is a reference.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from league.commands.cli import guarded
from league.config import experiment
from league.runs.bench import evaluation, metrics, references, tasks
from league.runs.bench.games import bench_league
from league.runs.bench.partial_rows import Row
from league.runs.bench.references import FOLDER, Reference
from league.runs.bench.tasks import Task
from league.snapshots import policy_file
from league.snapshots.policy_file import Policy
from scripts.record import ROOT
from storage.blobs import arrays

MANIFEST = FOLDER / "manifest.json"
ENTRIES = ROOT / "benchmarks" / "entries"


def listed() -> dict[str, Any]:
    """Return the manifest."""
    return json.loads(MANIFEST.read_text("utf-8"))


def write(manifest: dict[str, Any]) -> None:
    """Write the manifest."""
    MANIFEST.write_text(f"{json.dumps(manifest, indent=1)}\n", "utf-8")


def add(task: Task, file: Path, name: str, kind: str, stage: str, team: str | None, words: str) -> Reference:
    """Copy an exported policy into the package and list it. Raises StorageError for a file without a policy."""
    policy = policy_file.read(file)
    about, (stored, copies) = policy.about, of_one_agent(policy)
    copy = FOLDER / f"{task.name.rpartition('-')[0]}-{name.replace(':', '-')}.safetensors"
    copy.write_bytes(stored.to_bytes())
    settings = experiment.loads(about["settings"])
    entry = {
        "name": name, "kind": kind, "file": copy.name, "sha256": sha256_of(copy),
        "stage": stage, "seed": settings.seed, "steps": about["steps"],
        "provenance": words or f"{about['name']} of league {about['league']}, {about['steps']:,} steps,"
        f" seed {settings.seed}",
    }  # fmt: skip
    return enter(task, entry | ({"copies": copies} if copies > 1 else {}), team)


def add_shipped(task: Task, name: str, team: str | None, words: str) -> Reference:
    """List a policy that comes with the package. Raises UnknownName if there is none of that name."""
    sha256 = sha256_of(policy_file.find(name))
    entry = {"name": name, "kind": "shipped", "policy": name, "sha256": sha256, "provenance": words}
    return enter(task, entry, team)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def enter(task: Task, entry: dict[str, Any], team: str | None) -> Reference:
    """List a reference; a former one of that name goes, with its games."""
    entry, name = entry | ({"team": team} if team else {}), entry["name"]
    manifest = listed()
    own = manifest["tasks"].setdefault(task.name, {"references": []})
    keep_former(own, name)
    if "rows" in own:
        rows = json.loads((FOLDER / own["rows"]["file"]).read_text("utf-8"))
        _write_rows(task, own, [row for row in rows if name not in (row["a"], row["b"])])
    own["references"] = [each for each in own["references"] if each["name"] != name] + [entry]
    write(manifest)
    return Reference(**entry)


def keep_former(own: dict[str, Any], name: str) -> None:
    """Keep the set of references that entries met, before one of this name is added; drop sets which had that name."""
    names, digest = [each["name"] for each in own["references"]], references.digest(own)
    former = [each for each in own.get("former", []) if name not in each["names"]]
    met = {json.loads(file.read_text("utf-8"))["references"] for file in ENTRIES.glob("*.json")}
    if name not in names and digest in met:
        former.append({"digest": digest, "names": names})
    own.pop("former", None)
    own |= {"former": former} if former else {}


def of_one_agent(policy: Policy) -> tuple[Policy, int]:
    """Return the policy of one agent and the number of agents that act by it; 1 with the whole one if they differ."""
    agents: dict[str, dict[str, np.ndarray]] = {}
    for name, array in policy.arrays.items():
        number, _, own = name.partition("/")
        agents.setdefault(number, {})[own] = array
    first = agents["0"]
    equal = [
        own.keys() == first.keys() and all(np.array_equal(own[n], first[n]) for n in first) for own in agents.values()
    ]
    if not all(equal):
        return policy, 1
    one = {f"0/{name}": array for name, array in first.items()}
    digest = hashlib.sha256(arrays.to_bytes(one)).hexdigest()
    roster = policy.about["roster"].split("+")[0]
    about = {**policy.about, "roster": roster, "agents": policy.about["agents"][:1], "digest": digest}
    return Policy(one, about), len(agents)


def _write_rows(task: Task, own: dict[str, Any], rows: Sequence[Row]) -> None:
    """Write the games of a task's references beside the manifest, and their digest into its list."""
    path = FOLDER / f"{task.name}.rows.json"
    path.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", "utf-8")
    own["rows"] = {"file": path.name, "sha256": sha256_of(path)}


def play(task: Task, games: int) -> int:
    """Play the pairs of references that can meet and have not, add their rows, and return the number of all rows."""
    known = references.of(task)
    pairs, rows = list(evaluation.missing(task, known, known.references)), [*known.rows]
    with bench_league(task, games) as league:
        evaluation.bring_in(league, known.references)
        league.make_room()
        for number, (a, b) in enumerate(pairs, 1):
            print(f"{number} of {len(pairs)}: {a} against {b}", file=sys.stderr)
            rows += league.play(a, b, games, task.seed)
    manifest = listed()
    _write_rows(task, manifest["tasks"][task.name], rows)
    write(manifest)
    return len(rows)


def table(task: Task) -> str:
    """Return the ratings of a task's references, strongest first, fitted to their games; a side's mean is 1000."""
    fit = metrics.rated(task, (), references.of(task))
    rows = sorted(zip(fit.names, fit.elo, fit.low, fit.high, strict=True), key=lambda row: -row[1])
    return "\n".join(f"{name}: {elo:.0f} ({low:.0f} to {high:.0f})" for name, elo, low, high in rows)


def main(argv: Sequence[str] | None = None) -> int:
    """Add a reference, play a task's references, or print their ratings."""
    asked = argparse.ArgumentParser(description="References of Robot League Bench.")
    asked.add_argument("task", choices=list(tasks.TASKS))
    asked.add_argument(
        "--add", type=Path, metavar="FILE", help="a policy that `league export` wrote, or the name of a shipped one"
    )
    asked.add_argument("--name", help="of the reference")
    asked.add_argument("--kind", default="learnt", choices=["learnt", "exploiter", "shipped"])
    asked.add_argument("--stage", default="", choices=["", "early", "middle", "late"])
    asked.add_argument("--team", help="its side, where sides are unlike")
    asked.add_argument("--words", default="", help="its provenance (that of its file)")
    asked.add_argument("--play", type=int, metavar="GAMES", help="games of each pair that has none")
    options = asked.parse_args(argv)
    task = tasks.find(options.task)
    if options.add and options.kind == "shipped":
        print(add_shipped(task, str(options.add), options.team, options.words))
    elif options.add:
        print(add(task, options.add, options.name, options.kind, options.stage, options.team, options.words))
    if options.play:
        print(f"{play(task, options.play)} rows")
    if not (options.add or options.play):
        print(table(task))
    return 0


if __name__ == "__main__":
    sys.exit(guarded(main))
