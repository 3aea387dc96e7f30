"""Faults planted one at a time, and the first quick test that finds each.

    python -m experiments.mutations --out experiments/results/mutations-after.json
    python -m experiments.mutations --tree OLD --before --out experiments/results/mutations-before.json
    python -m experiments.mutations --table experiments/results/mutations-{before,after}.json

`mutations.json` has the faults: `fragment` of `file` becomes `mutant`. They were written against the commit that it
names (`--before`); `after` has what differs in the present tree. For each fault the quick tests run in three steps
until one fails: the files `near`, the rest of `tests/<package>`, all others. A test counts only if it fails again when
it runs alone, and passes without the fault. `seconds` are CPU time of all these runs; `found` is null if no test of the
steps that were run finds the fault, and `step` is the last of them.

The file in a tree has its own text again after each run, also after Ctrl-C or a timeout. Results go to `--out` one by
one; a fault that is there already is left out unless `--only` names it.
"""

import argparse
import datetime
import json
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

FAULTS = Path(__file__).with_name("mutations.json")
QUICK = ("-x", "-q", "-n", "0", "-m", "not slow and not gpu", "--tb=no", "-rfE", "--durations=0", "--durations-min=1e9")
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)
STEPS = ("near", "package", "all")
PASSED = (0, 5)  # exit codes of pytest: all passed, no test was selected


def main() -> None:
    """Plant the faults in a tree and write the results, or print a table of two results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", type=Path, default=Path(), help="root of the tree, with its .venv (default: here)")
    parser.add_argument(
        "--before", action="store_true", help="the tree has the layout that the faults were written for"
    )
    parser.add_argument("--out", type=Path, help="add the results to this JSON")
    parser.add_argument("--only", nargs="+", metavar="ID", help="faults to plant, even if they have a result")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=STEPS, help="steps to run (default: all three)")
    parser.add_argument("--limit", type=float, default=1800, help="seconds after which a run counts as hung")
    parser.add_argument("--table", nargs=2, type=Path, metavar=("BEFORE", "AFTER"), help="print a table and end")
    args = parser.parse_args()
    faults = json.loads(FAULTS.read_text("utf-8"))["faults"]
    if args.table:
        print(table(faults, *(json.loads(path.read_text("utf-8")) for path in args.table)))
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `finally` runs
    results = json.loads(args.out.read_text("utf-8")) if args.out and args.out.exists() else {}
    for fault in faults:
        if fault["id"] in (args.only or {f["id"] for f in faults} - results.keys()):
            located = fault if args.before else fault | fault["after"]
            found = examine(args.tree.resolve(), located, args.steps, args.limit)
            results[fault["id"]] = found
            print(fault["id"], json.dumps(found), flush=True)
            if args.out:
                args.out.write_text(json.dumps(results, indent=1) + "\n", "utf-8")


def examine(tree: Path, fault: dict, chosen: Sequence[str], limit: float) -> dict:
    """Return which test finds a fault, in which step, and the CPU seconds until then."""
    package, near = f"tests/{fault['package']}", fault["near"]
    if missing := [path for path in near if not (tree / path).exists()]:
        sys.exit(f"{fault['id']}: {FAULTS.name} names tests that {tree} does not have: {', '.join(missing)}")
    tests = {"near": near, "package": [package, *left_out(near)], "all": ["tests", *left_out([package])]}
    began = cpu_seconds()
    findings = ((step, finder(tree, fault, tests[step], limit)) for step in chosen)
    step, found = next((finding for finding in findings if finding[1]), (chosen[-1], None))
    commit = ["git", "-C", str(tree), "rev-parse", "--short", "HEAD"]
    return {
        "found": found, "step": step, "seconds": round(cpu_seconds() - began),
        "commit": subprocess.run(commit, capture_output=True, text=True, check=True).stdout.strip(),
        "date": datetime.date.today().isoformat(),
    }  # fmt: skip


def finder(tree: Path, fault: dict, tests: list[str], limit: float) -> str | None:
    """Return the first of these tests that fails twice with a fault and passes without it, or None."""
    skipped: list[str] = []
    while True:
        with planted(tree / fault["file"], fault["fragment"], fault["mutant"]):
            failed = first_failure(tree, [*tests, *left_out(skipped)], limit)
            if failed is None or "::" not in failed:
                return failed
            again = first_failure(tree, [failed], limit)
        if again and first_failure(tree, [failed], limit) is None:
            return failed
        print(f"{failed} does not tell {fault['id']} from none", file=sys.stderr, flush=True)
        skipped.append(failed)


@contextmanager
def planted(file: Path, fragment: str, mutant: str) -> Iterator[None]:
    """Replace a fragment that occurs once in a file, and give the file its own bytes again at the end."""
    own = file.read_bytes()
    if (number := own.count(fragment.encode())) != 1:
        sys.exit(f"{file} has {fragment!r} {number} times, not once: correct {FAULTS.name}")
    file.write_bytes(own.replace(fragment.encode(), mutant.encode()))
    try:
        yield
    finally:
        file.write_bytes(own)


def first_failure(tree: Path, arguments: list[str], limit: float) -> str | None:
    """Run quick tests; return the first that fails, or an error or timeout outside a test in words, or None."""
    command = [str(tree / ".venv/bin/python"), "-m", "pytest", *QUICK, *arguments]
    with subprocess.Popen(
        command, cwd=tree, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as running:
        try:
            output, _ = running.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            return f"no end within {limit:.0f} s"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(running.pid, signal.SIGKILL)  # with what the tests may have started
    if running.returncode in PASSED:
        return None
    if failed := FAILED.search(output):
        return failed[1]
    if running.returncode > 0:
        sys.exit(f"{' '.join(command)} ended with exit code {running.returncode}:\n{output[-2000:]}")
    return f"signal {-running.returncode}"


def left_out(tests: list[str]) -> list[str]:
    """Return pytest's arguments that leave out tests, files or folders."""
    return [f"--deselect={test}" if "::" in test else f"--ignore={test}" for test in tests]


def cpu_seconds() -> float:
    """Return the CPU time in seconds of all processes that this one has waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(faults: list[dict], before: dict, after: dict) -> str:
    """Return a Markdown table of faults and the tests that found them."""
    rows = [
        f"| {fault['id']} | {fault['what']} | {cell(before.get(fault['id']))} | {cell(after.get(fault['id']))} |"
        for fault in faults
    ]
    return "\n".join(["| | fault | found before by | found after by |", "|---|---|---|---|", *rows])


def cell(result: dict | None) -> str:
    """Return a test's file and name without parameters, and the step that it belongs to and its CPU seconds."""
    if result is None:
        return "not run"
    cost = f"{result['step']}, {result['seconds']} s"
    if result["found"] is None:
        return f"**nothing** ({cost})"
    file, _, test = result["found"].partition("::")
    named = f"`{test.partition('[')[0]}` in `{file.removeprefix('tests/')}`" if test else file
    return f"{named} ({cost})"


if __name__ == "__main__":
    main()
