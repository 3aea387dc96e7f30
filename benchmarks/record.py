"""What every benchmark writes beside its figures: machine, versions and commit, and figures as a few numbers."""

import json
import os
import platform
import subprocess
from pathlib import Path

import numpy as np


def machine() -> dict:
    """What it ran on."""
    import jax

    told = Path("/proc/cpuinfo")
    lines = told.read_text().splitlines() if told.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if "model name" in line), "")
    return {
        "cpu": model or platform.processor(),
        "cores": os.cpu_count(),
        "devices": [device.device_kind for device in jax.devices()],
    }


def commit() -> str:
    """The commit that ran, with + where the tree was changed."""
    head = subprocess.run(["git", "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=False)
    return head.stdout.strip() or "unknown"


def tell(figures: dict, out: Path | None) -> None:
    """Print a benchmark's figures as JSON, and write them where that is asked for."""
    text = json.dumps(figures, indent=2)
    print(text)
    if out:
        out.write_text(text + "\n")


def own_and_further(argv: list[str]) -> tuple[list[str], list[str]]:
    """A benchmark's arguments, and those after `--`, which argparse loses where other positional ones come first."""
    at = argv.index("--") if "--" in argv else len(argv)
    return argv[:at], argv[at + 1 :]


def spread(values: list[float] | np.ndarray, digits: int = 3) -> dict:
    """Median, smallest and largest of repetitions."""
    return {name: round(float(f(values)), digits) for name, f in (("median", np.median), ("min", min), ("max", max))}


def tail(values: np.ndarray) -> dict:
    """Mean, upper percentiles and the largest of many, and how many there were: three digits each."""
    shares = {"p50": 50, "p99": 99, "p99.99": 99.99}
    values = np.asarray(values).ravel()
    found = {"mean": values.mean(), **{k: np.percentile(values, q) for k, q in shares.items()}, "max": values.max()}
    return {name: float(f"{x:.3g}") for name, x in found.items()} | {"n": int(values.size)}
