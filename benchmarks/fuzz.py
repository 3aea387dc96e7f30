"""Bad input by class, thousands of cases, and how the command line answers: counts, and each bad answer once.

    python benchmarks/fuzz.py --cases 10000 --out benchmarks/results/fuzz-cpu.json
    python benchmarks/fuzz.py --cases 200 --classes rows --seed 7

Each case (benchmarks/hostile.py) is a command in this process, through the command line's own `main`, in a copy of a
folder with a small store. A good answer takes less than 20 s and is either what was asked for, or exit code 2 with one
line that tells no password, and then nothing in the folder is new or changed. Cases that turn out to be possible are
counted apart. Classes that are not tried this time keep their counts in the file.
"""

import argparse
import contextlib
import hashlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings

sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks.hostile import CLASSES, FILES, READING, SECRET, Case  # noqa: E402
from benchmarks.record import commit, machine, tell  # noqa: E402
from league import cli  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from storage.store import Store  # noqa: E402
from tests.storage.sound import fill  # noqa: E402

HANGS = 20  # seconds
SUMS = ("cases", "refused in one line", "possible", "bad")
FOUND = ("verify", "gate", "sprt")  # commands whose exit codes 1 and 3 are answers


class Hangs(BaseException):
    """A command took too long."""


@dataclass
class Tally:
    """How the cases of a class were answered."""

    refused: int = 0  # in one line, with exit code 2
    possible: int = 0  # it did what was asked
    bad: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)  # of bad answers, one of each kind

    @property
    def cases(self) -> int:
        """How many there were."""
        return self.refused + self.possible + self.bad.total()

    @property
    def figures(self) -> dict[str, int | dict[str, int]]:
        """The counts as they are written."""
        told = {"cases": self.cases, "refused in one line": self.refused, "possible": self.possible}
        return told | {"bad": self.bad.total(), "how": dict(self.bad)}


def corpus(folder: Path) -> None:
    """What every case begins with."""
    with Store.open(folder / "store", create=True) as store:
        fill(store)
    (folder / FILES["toml"]).write_text(configuration.dumps(configuration.default()))
    rows = ("arena,side_a,side_b,wins_a,draws,wins_b", *(f"ring,a{i},a{i + 1},{i + 1},1,2" for i in range(5)))
    (folder / FILES["csv"]).write_text("\n".join(rows))
    (folder / FILES["matrix"]).write_text("rock,paper,scissors\n0,-1,1\n1,0,-1\n-1,1,0")
    trained = sorted((Path(cli.__file__).parent / "trained").glob("*.safetensors"))
    shutil.copyfile(trained[0], folder / FILES["policy"])
    code, _, err = answer(("pack", FILES["zip"], "--store", "store"), folder)
    assert code == 0, err


def answer(args: tuple[str, ...], folder: Path) -> tuple[int, str, str]:
    """Exit code, output and errors of a command in a folder, -1 for one that hangs."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", errors) for errors in ("strict", "backslashreplace"))
    with _in(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(list(args))
            code = 0
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        except Hangs:
            code = -1
    told = []
    for stream in (out, err):
        stream.flush()
        told.append(stream.buffer.getvalue().decode(errors="replace"))  # type: ignore[attr-defined]
    return code, *told


@contextlib.contextmanager
def _in(folder: Path) -> Iterator[None]:
    """Work there, and not for too long."""

    def stop(*_: object) -> None:
        raise Hangs

    before, here = signal.signal(signal.SIGALRM, stop), Path.cwd()
    signal.alarm(HANGS)
    os.chdir(folder)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        os.chdir(here)


def complaint(case: Case, code: int, out: str, err: str, changed: list[str]) -> str:
    """What is bad about an answer; empty for a good one."""
    if code == -1:
        return "hangs"
    if SECRET in out + err:
        return "tells a password"
    if code not in (0, 2) and not (code in (1, 3) and case.args[0] in FOUND and not err):
        return f"exit code {code}: {err.partition(':')[2].strip().partition(':')[0]}"
    if code == 2 and (err.count("\n") != 1 or not err.startswith("league: ") or len(err) > cli.LINE + 20):
        return f"{err.count(chr(10))} lines, {len(err)} characters"
    if changed and (code == 2 or case.args[0] in READING):
        return f"changes {', '.join(sorted({Path(name).parts[0] for name in changed}))}"
    return ""


def tried(case: Case, kept: Path, folder: Path) -> tuple[int, str, str]:
    """Answer a case in a copy of the folder: exit code, complaint and the words that were said."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(kept, folder)
    if case.harm:
        case.harm(folder)
    before = contents(folder)
    code, out, err = answer(case.args, folder)
    after = contents(folder)
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    return code, complaint(case, code, out, err, changed), err


def contents(folder: Path) -> dict[str, str]:
    """The files of a folder by their bytes, less what SQLite keeps beside a database while it is read."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.endswith(("-wal", "-shm")))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def tally(name: str, cases: int, kept: Path, folder: Path, random: int) -> Tally:
    """Try so many cases of a class."""
    counted = Tally()

    @seed(random)
    @settings(
        max_examples=cases, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(CLASSES[name](kept))
    def probe(case: Case) -> None:
        code, bad, said = tried(case, kept, folder)
        if bad:
            counted.bad[bad] += 1
            counted.examples.setdefault(bad, f"{' '.join(case.args)[:300]!r} {case.told}: {said[-300:]}")
        elif code == 2:
            counted.refused += 1
        else:
            counted.possible += 1

    probe()
    return counted


def main() -> int:
    """Try them, print and write the counts; 1 where an answer was bad."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000, help="of all classes together")
    parser.add_argument("--classes", nargs="+", default=list(CLASSES), choices=list(CLASSES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    classes = json.loads(asked.out.read_text())["classes"] if asked.out and asked.out.exists() else {}
    with tempfile.TemporaryDirectory() as place:
        corpus(kept := Path(place) / "kept")
        for name in asked.classes:
            found = tally(name, asked.cases // len(asked.classes), kept, Path(place) / "case", asked.seed)
            print(f"{name}: {found}", file=sys.stderr, flush=True)
            classes[name] = {"commit": commit(), "seed": asked.seed, **found.figures}
    total = {name: sum(each[name] for each in classes.values()) for name in SUMS}
    tell({"machine": machine(), **total, "classes": classes}, asked.out)
    return 1 if any(classes[name]["bad"] for name in asked.classes) else 0


if __name__ == "__main__":
    sys.exit(main())
