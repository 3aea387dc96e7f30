"""Parts common to scripts that measure: arguments, where they ran, files of results, and statistics of figures.

Used by benchmarks, experiments and the campaigns in tests/faults.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np

from league.system.packages.versions import versions

ROOT = Path(__file__).resolve().parents[1]


def make_parser(description: str | None, *, out_required: bool = False) -> argparse.ArgumentParser:
    """Return a parser with the arguments common to measuring scripts, `--commit` and `--out`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("--out", type=Path, required=out_required, help="write the result here, as JSON")
    return parser


def split_arguments(argv: list[str]) -> tuple[list[str], list[str]]:
    """Split a script's own arguments from those after `--`, which argparse loses behind other positional arguments."""
    at = argv.index("--") if "--" in argv else len(argv)
    return argv[:at], argv[at + 1 :]


def run_info(named_commit: str = "") -> dict:
    """Describe this run: command line, commit, machine and package versions.

    Initialises JAX's devices; call it after the runs of other processes that need a whole GPU.

    Args:
        named_commit: the value of `--commit`; empty: ask git.
    """
    return {
        "command": command_line(), "commit": named_commit or commit(), "machine": machine(), "versions": versions(),
    }  # fmt: skip


def command_line() -> str:
    """Return the command that started this process, without the folder that it ran in."""
    spec = sys.modules["__main__"].__spec__
    program = ["-m", spec.name] if spec else [Path(sys.argv[0]).name]
    return " ".join(["python", *program, *sys.argv[1:]])


def machine() -> dict:
    """Describe the machine: CPU model, number of cores, and JAX's devices."""
    import jax

    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if "model name" in line), "")
    return {
        "cpu": model or platform.processor(),
        "cores": os.cpu_count(),
        "devices": [device.device_kind for device in jax.devices()],
    }


def commit() -> str:
    """Return the abbreviated commit of this tree, with + if the tree has changes; "unknown" without git."""
    command = ["git", "describe", "--always", "--dirty=+"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def write(result: dict, out: Path | None) -> None:
    """Write a result as JSON, if a file is asked for."""
    if out:
        out.write_text(json.dumps(result, indent=1) + "\n")


def report(result: dict, out: Path | None) -> None:
    """Print a result as JSON, and write it if a file is asked for."""
    print(json.dumps(result, indent=1), flush=True)
    write(result, out)


def spread(values: list[float] | np.ndarray, digits: int = 3) -> dict:
    """Return median, minimum and maximum of repetitions."""
    return {name: round(float(f(values)), digits) for name, f in (("median", np.median), ("min", min), ("max", max))}


def tail(values: np.ndarray) -> dict:
    """Return mean, upper percentiles and maximum with three digits each, and the number of values as `n`."""
    shares = {"p50": 50, "p99": 99, "p99.99": 99.99}
    values = np.asarray(values).ravel()
    found = {"mean": values.mean(), **{k: np.percentile(values, q) for k, q in shares.items()}, "max": values.max()}
    return {name: float(f"{x:.3g}") for name, x in found.items()} | {"n": int(values.size)}
