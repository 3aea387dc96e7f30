"""Campaign of bad input by class, thousands of cases: counts of the command line's answers, and each bad answer once.

    python -m tests.faults.fuzz --cases 10000 --out tests/faults/results/fuzz-cpu.json
    python -m tests.faults.fuzz --cases 200 --classes rows --seed 7

Each case (tests/faults/hostile.py, hostile_words.py) is a command in this process, through the command line's own
`main`, in a copy of a folder with a small store. A good answer takes less than 20 s of CPU time, and 120 s in all. It
is the requested result, or exit code 2 or 75 with one line without a password, and then nothing in the folder is new or
changed. In every output encoding, all printed characters are visible, no CSV cell is one that a spreadsheet evaluates,
and JSON is valid. Cases that turn out to be possible are counted separately. Classes that are not tried this time keep
their counts in the file. Exit code 1 if an answer was bad.
"""

import contextlib
import csv
import hashlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

from dashboards.untrusted_text import FORMULA
from league.commands import cli
from league.config import experiment as configuration
from league.snapshots import policy_file
from league.system import exit_codes
from scripts.record import commit, machine, make_parser, report
from storage.store import Store
from tests.faults import hostile, hostile_words
from tests.faults.hostile import FILES, READING, SECRET, Case
from tests.storage.sound import fill

CLASSES = {**hostile.CLASSES, **hostile_words.CLASSES}
HANGS = 20  # seconds of CPU time: on a loaded machine an answer may take longer
WAITS = 120  # seconds in all
REFUSED = (exit_codes.BAD_INPUT, exit_codes.PASSING)
SUMS = ("cases", "refused in one line", "possible", "bad")
FOUND = ("verify", "gate", "sprt")  # commands for which exit codes 1 and 3 are results


class Hangs(BaseException):
    """A command took too long."""


@dataclass
class Tally:
    """Counts of the answers to the cases of a class."""

    refused: int = 0  # in one line, with exit code 2 or 75
    possible: int = 0  # the command did what was requested
    bad: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)  # one bad answer of each kind

    @property
    def cases(self) -> int:
        """The number of cases."""
        return self.refused + self.possible + self.bad.total()

    @property
    def figures(self) -> dict[str, int | dict[str, int]]:
        """The counts as they are written."""
        counts = {"cases": self.cases, "refused in one line": self.refused, "possible": self.possible}
        return counts | {"bad": self.bad.total(), "how": dict(self.bad)}


def corpus(folder: Path) -> None:
    """Create the folder with which every case begins."""
    with Store.open(folder / "store", create=True) as store:
        fill(store)
    (folder / FILES["toml"]).write_text(configuration.dumps(configuration.default()))
    rows = ("arena,side_a,side_b,wins_a,draws,wins_b", *(f"ring,a{i},a{i + 1},{i + 1},1,2" for i in range(5)))
    (folder / FILES["csv"]).write_text("\n".join(rows))
    (folder / FILES["matrix"]).write_text("rock,paper,scissors\n0,-1,1\n1,0,-1\n-1,1,0")
    trained = sorted(policy_file.TRAINED.glob("*.safetensors"))
    shutil.copyfile(trained[0], folder / FILES["policy"])
    code, _, err = answer(("pack", FILES["zip"], "--store", "store"), folder)
    assert code == 0, err


def answer(args: tuple[str, ...], folder: Path, encoding: str = "utf-8") -> tuple[int, str, str]:
    """Run a command in a folder; return exit code (-1 if it hangs), output and errors."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding, errors) for errors in ("strict", "backslashreplace"))
    with _in(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(list(args))
            code = 0
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        except Hangs:
            code = -1
    texts = []
    for stream in (out, err):
        stream.flush()
        texts.append(stream.buffer.getvalue().decode(encoding, errors="replace"))  # type: ignore[attr-defined]
    return code, *texts


@contextlib.contextmanager
def _in(folder: Path) -> Iterator[None]:
    """Change to a folder, with a time limit. Raises Hangs."""
    used, begun = time.process_time(), time.monotonic()

    def stop(*_: object) -> None:
        if time.process_time() - used > HANGS or time.monotonic() - begun > WAITS:
            raise Hangs

    before, here = signal.signal(signal.SIGALRM, stop), Path.cwd()
    signal.setitimer(signal.ITIMER_REAL, HANGS, 1.0)
    os.chdir(folder)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        os.chdir(here)


def complaint(case: Case, code: int, out: str, err: str, changed: list[str]) -> str:
    """Describe what is bad about an answer; empty for a good one."""
    if code == -1:
        return "hangs"
    if SECRET in out + err:
        return "prints a password"
    if code not in (exit_codes.DONE, *REFUSED) and not (code in (1, 3) and case.args[0] in FOUND and not err):
        return f"exit code {code}: {err.partition(':')[2].strip().partition(':')[0]}"
    if code in REFUSED and (err.count("\n") != 1 or not err.startswith("league: ") or len(err) > cli.LINE + 20):
        return f"{err.count(chr(10))} lines, {len(err)} characters"
    if unsafe := _unsafe(case, code, out, err):
        return unsafe
    if changed and (code in REFUSED or case.args[0] in READING):
        return f"changes {', '.join(sorted({Path(name).parts[0] for name in changed}))}"
    return ""


def _unsafe(case: Case, code: int, out: str, err: str) -> str:
    """Describe output that a terminal, a spreadsheet or a program would misread; empty if there is none."""
    if not all(line.isprintable() for line in (out + err).split("\n")):
        return "prints invisible characters"
    if "csv" in case.args and any(row[0].lstrip().startswith(FORMULA) for row in csv.reader(io.StringIO(out)) if row):
        return "a cell that is evaluated"
    if "json" in case.args and code == 0 and "--help" not in case.args:
        try:
            json.loads(out)
        except ValueError:
            return "JSON that is none"
    return ""


def tried(case: Case, kept: Path, folder: Path) -> tuple[int, str, str]:
    """Run a case in a copy of the folder; return exit code, complaint and standard error."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(kept, folder)
    if case.harm:
        case.harm(folder)
    before = contents(folder)
    code, out, err = answer(case.args, folder, case.encoding)
    after = contents(folder)
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    return code, complaint(case, code, out, err, changed), err


def contents(folder: Path) -> dict[str, str]:
    """Return the digests of a folder's files, without those that SQLite keeps beside a database while reading."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.endswith(("-wal", "-shm")))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def tally(name: str, cases: int, kept: Path, folder: Path, random: int) -> Tally:
    """Try this number of cases of a class."""
    counted = Tally()

    @seed(random)
    @settings(
        max_examples=cases, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(CLASSES[name](kept))
    def probe(case: Case) -> None:
        code, bad, errors = tried(case, kept, folder)
        if bad:
            counted.bad[bad] += 1
            counted.examples.setdefault(bad, f"{' '.join(case.args)[:300]!r} {case.detail}: {errors[-300:]}")
        elif code in (2, 75):
            counted.refused += 1
        else:
            counted.possible += 1

    probe()
    return counted


def main() -> int:
    """Run the campaign; return 1 if an answer was bad."""
    parser = make_parser(__doc__)
    parser.add_argument("--cases", type=int, default=10_000, help="of all classes together")
    parser.add_argument("--classes", nargs="+", default=list(CLASSES), choices=list(CLASSES))
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    classes = json.loads(asked.out.read_text())["classes"] if asked.out and asked.out.exists() else {}
    with tempfile.TemporaryDirectory() as place:
        corpus(kept := Path(place) / "kept")
        for name in asked.classes:
            found = tally(name, asked.cases // len(asked.classes), kept, Path(place) / "case", asked.seed)
            print(f"{name}: {found}", file=sys.stderr, flush=True)
            classes[name] = {"commit": asked.commit or commit(), "seed": asked.seed, **found.figures}
    total = {name: sum(each[name] for each in classes.values()) for name in SUMS}
    report({"machine": machine(), **total, "classes": classes}, asked.out)
    return 1 if any(classes[name]["bad"] for name in asked.classes) else 0


if __name__ == "__main__":
    sys.exit(main())
