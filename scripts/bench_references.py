"""The references of Robot League Bench: add policies to a task, and play all of a task's references against each other.

    python -m scripts.bench_references t1-sumo-rovers-v1 --add blue@16.safetensors --name happo-middle --stage middle
    python -m scripts.bench_references t1-sumo-rovers-v1 --play 256   # writes the games, to which ratings are fitted

A change of a task's references changes their digest: entries that met the former ones have to be played again.
"""

import argparse
import hashlib
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from league.commands.cli import guarded
from league.config import experiment
from league.runs.bench import evaluation, references, tasks
from league.runs.bench.games import bench_league
from league.runs.bench.references import FOLDER, Reference, ReferenceSet
from league.runs.bench.tasks import Task
from league.snapshots import policy_file

MANIFEST = FOLDER / "manifest.json"


def listed() -> dict[str, Any]:
    """Return the manifest."""
    return json.loads(MANIFEST.read_text("utf-8"))


def write(manifest: dict[str, Any]) -> None:
    """Write the manifest."""
    MANIFEST.write_text(f"{json.dumps(manifest, indent=1)}\n", "utf-8")


def add(task: Task, file: Path, name: str, kind: str, stage: str, team: str | None, words: str) -> Reference:
    """Copy an exported policy into the package and list it; games against the former references are no longer enough.

    Raises StorageError for a file without a policy.
    """
    about = policy_file.read(file).about
    copy = FOLDER / f"{task.name.rpartition('-')[0]}-{name.replace(':', '-')}.safetensors"
    shutil.copyfile(file, copy)
    settings = experiment.loads(about["settings"])
    entry = {
        "name": name, "kind": kind, "file": copy.name, "sha256": hashlib.sha256(copy.read_bytes()).hexdigest(),
        "stage": stage, "seed": settings.seed, "steps": about["steps"],
        "provenance": words or f"{about['name']} of league {about['league']}, {about['steps']:,} steps,"
        f" seed {settings.seed}",
    }  # fmt: skip
    entry |= {"team": team} if team else {}
    manifest = listed()
    own = manifest["tasks"].setdefault(task.name, {"references": []})
    own["references"] = [each for each in own["references"] if each["name"] != name] + [entry]
    write(manifest)
    return Reference(**entry)


def play(task: Task, games: int) -> int:
    """Play each two references that can meet, write the rows, and return their number."""
    known = references.of(task)
    pairs = list(evaluation.missing(task, ReferenceSet(known.references, (), ""), known.references))
    rows = []
    with bench_league(task, games) as league:
        evaluation.bring_in(league, known.references)
        league.make_room()
        for number, (a, b) in enumerate(pairs, 1):
            print(f"{number} of {len(pairs)}: {a} against {b}", file=sys.stderr)
            rows += league.play(a, b, games, task.seed)
    path = FOLDER / f"{task.name}.rows.json"
    path.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", "utf-8")
    manifest = listed()
    manifest["tasks"][task.name]["rows"] = {
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "games": games,
    }
    write(manifest)
    return len(rows)


def main(argv: Sequence[str] | None = None) -> int:
    """Add a reference, or play a task's references."""
    asked = argparse.ArgumentParser(description="References of Robot League Bench.")
    asked.add_argument("task", choices=list(tasks.TASKS))
    asked.add_argument("--add", type=Path, metavar="FILE", help="a policy that `league export` wrote")
    asked.add_argument("--name", help="of the reference")
    asked.add_argument("--kind", default="learnt", choices=["learnt", "exploiter"])
    asked.add_argument("--stage", default="", choices=["", "early", "middle", "late"])
    asked.add_argument("--team", help="its side, where sides are unlike")
    asked.add_argument("--words", default="", help="its provenance (that of its file)")
    asked.add_argument("--play", type=int, metavar="GAMES", help="games of each pair")
    options = asked.parse_args(argv)
    task = tasks.find(options.task)
    if options.add:
        print(add(task, options.add, options.name, options.kind, options.stage, options.team, options.words))
    if options.play:
        print(f"{play(task, options.play)} rows")
    return 0


if __name__ == "__main__":
    sys.exit(guarded(main))
