"""Blobs and whole leagues on a real S3 server behind a proxy that injects faults. Counts add up over runs.

    python -m tests.storage.object_storage --out tests/faults/results/object-storage-cpu.json
    python -m tests.storage.object_storage --parts operations --faults late stale --server moto

Starts a Ceph cluster with its S3 gateway (Debian's packages ceph-mon, ceph-osd and radosgw) and a proxy before it.
`operations`: processes put and get blobs, and repeat what is away, while one fault after another is injected; then all
that was put must be there and right, and `recovery` is the time until an operation succeeds again. `leagues`: the real
command with `--blobs s3://...` while all faults take turns; rock, paper, scissors must end as a league left alone, to
the last byte, and sumo on the C engine without a failed job or a row without its blob. Exit code 1 if anything was
lost.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from scripts.record import commit, machine, make_parser, write
from storage.blobs.s3 import BucketBlobs
from tests.faults.hunted import Lost, examine
from tests.storage.object_storage import moto_server
from tests.storage.object_storage.ceph import Ceph
from tests.storage.object_storage.leagues import (
    SUMO,
    BucketHunted,
    Check,
    compared,
    disturbed,
    messages,
    verified,
)  # fmt: skip
from tests.storage.object_storage.operations import lost, operate
from tests.storage.object_storage.proxy import Faults, Proxy

BUCKET = "blobs"
FAULTS = {
    "none": Faults(),
    "late": Faults(late=1.0, share=0.5),
    "error-500": Faults(status=500, share=0.3),
    "slow-down-503": Faults(status=503, code="SlowDown", share=0.3),
    "answer-lost": Faults(status=500, after=True, share=0.3),
    "upload-cut": Faults(cut="upload", only="PUT", share=0.3),
    "download-cut": Faults(cut="download", only="GET", share=0.3),
    "shorter": Faults(damage="shorter", only="GET", share=0.2),
    "changed": Faults(damage="changed", only="GET", share=0.2),
    "stale": Faults(stale=3.0),
    "throttled": Faults(rate=100_000, limit=20),
    "silent": Faults(silent=True, share=0.03),
}


@contextmanager
def server(kind: str, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the address of an S3 server and its version."""
    if kind == "moto":
        with moto_server.server() as url:
            yield url, "moto"
        return
    ceph = Ceph(folder)
    try:
        yield ceph.url, ceph.version()
    finally:
        ceph.stop()


class Campaign:
    """The parts of a run, with the counts so far."""

    def __init__(self, asked: argparse.Namespace, found: dict[str, Any], proxy: Proxy, folder: Path):
        self.asked, self.found, self.proxy, self.folder = asked, found, proxy, folder
        self.chosen = {name: FAULTS[name] for name in asked.faults or FAULTS}

    def operations(self) -> None:
        """Operate on blobs under each fault."""
        workers, known = self.asked.workers, list[str]()
        url = f"s3://{BUCKET}/operations"
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            for name, fault in self.chosen.items():
                self.proxy.faults, before = fault, self.proxy.requests.copy()
                began = time.monotonic()
                args = [(url, n, self.asked.operations, known[-50:]) for n in range(workers)]
                outcomes = [each.result(900) for each in [pool.submit(operate, *each) for each in args]]
                took, self.proxy.faults = time.monotonic() - began, Faults()
                recovery = self._recovery(url)
                put = [digest for outcome in outcomes for digest in outcome["put"]]
                wrong = lost(url, put) + [line for outcome in outcomes for line in outcome["strange"]]
                counts = sum((Counter(outcome["counts"]) for outcome in outcomes), Counter())
                requests = sum((self.proxy.requests - before)[method] for method in ("GET", "HEAD", "PUT"))
                self._add("operations", name, {**counts, "requests": requests, "lost": len(wrong)}, took, {
                    "longest_s": round(max(outcome["longest"] for outcome in outcomes), 1), "recovery_s": recovery
                })  # fmt: skip
                known += put
                if wrong:
                    self.found["lost"].append({"fault": name, "what": wrong[:5]})

    def leagues(self) -> None:
        """Run leagues while faults take turns."""
        alone = BucketHunted(self.folder / "alone", BUCKET, self.asked.steps)
        alone.finish()
        expected = examine(alone)[0]
        for n in range(self.asked.leagues):
            self._league(f"rps{n}", (), lambda hunted: compared(hunted, expected))
        for n in range(self.asked.sumo):
            self._league(f"sumo{n}", SUMO, verified)

    def _league(self, name: str, flags: tuple[str, ...], check: Check) -> None:
        hunted = BucketHunted(self.folder / name, BUCKET, self.asked.steps, flags)
        before, began = self.proxy.requests.copy(), time.monotonic()
        try:
            disturbed(hunted, self.proxy, self.chosen, self.asked.limit)
            counts = check(hunted) | {"messages": messages(hunted), "leagues": 1}
        except Lost as error:
            self.found["lost"].append({"league": name, "what": str(error)[:1000]})
            print(f"{name}: {error}\n{self.folder} is kept", flush=True)
            return
        finally:
            hunted.end()
        hit = {f"fault {what}": n for what, n in (self.proxy.requests - before).items()}
        self._add("leagues", name.rstrip("0123456789"), counts | hit, time.monotonic() - began, {})

    def _recovery(self, url: str) -> float:
        """Return the seconds until an operation succeeds after the end of a fault."""
        began = time.monotonic()
        operate(url, 0, 1, [])
        return round(time.monotonic() - began, 2)

    def _add(self, part: str, name: str, counts: dict[str, int], took: float, also: dict[str, float]) -> None:
        before = self.found[part].get(name, {})
        summed = {what: before.get(what, 0) + n for what, n in counts.items()}
        worst = {what: max(value, before.get(what, 0)) for what, value in also.items()}
        self.found[part][name] = {**before, **summed, **worst}
        print(f"{part} {name}: {json.dumps(counts)}, {took:.0f} s, {json.dumps(also)}", flush=True)
        write(self.found, self.asked.out)


def main() -> int:
    """Run the parts; return 1 if anything was lost."""
    parts = {"operations": Campaign.operations, "leagues": Campaign.leagues}
    parser = make_parser(__doc__)
    parser.add_argument("--parts", nargs="+", choices=parts, default=[*parts])
    parser.add_argument("--server", choices=("ceph", "moto"), default="ceph")
    parser.add_argument("--faults", nargs="+", choices=FAULTS)
    parser.add_argument("--operations", type=int, default=60, help="of each process, under each fault")
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--leagues", type=int, default=2, help="of rock, paper, scissors")
    parser.add_argument("--sumo", type=int, default=1, help="leagues of sumo")
    parser.add_argument("--steps", type=int, default=10_240, help="of training in a league")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds of a league")
    asked = parser.parse_args()
    earlier = json.loads(asked.out.read_text()) if asked.out and asked.out.exists() else {}
    found = {"commit": asked.commit or commit(), "machine": machine()}
    found |= {name: earlier.get(name, {}) for name in parts} | {"lost": earlier.get("lost", [])}
    lost_before = len(found["lost"])
    folder = Path(tempfile.mkdtemp(prefix="object-storage-"))
    os.environ.update(moto_server.KEYS)
    with server(asked.server, folder / "server") as (url, version), Proxy(url) as proxy:
        found["server"], os.environ["AWS_ENDPOINT_URL"] = version, proxy.url
        BucketBlobs(BUCKET, "")._s3.mkdir(BUCKET)
        campaign = Campaign(asked, found, proxy, folder)
        for name in asked.parts:
            parts[name](campaign)
    write(found, asked.out)
    if len(found["lost"]) > lost_before:
        print(json.dumps(found["lost"][lost_before:], indent=1))
        return 1
    shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
