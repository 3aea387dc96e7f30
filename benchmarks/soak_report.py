"""Result of the soak: means over five minutes, slopes per hour with intervals, and a figure.

A slope is of a line through the means of all parts, with an intercept for each part, because every part starts its
processes afresh; the first SETTLING minutes of a part do not count. The 95 % interval is Student's, on the residuals
of those means. Drift of speed is the slope of the logarithm of steps per second.
"""

import json
import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import t as student

BLOCK = 300.0  # seconds
SETTLING = 15.0  # minutes of each part in which processes compile and fill their caches
HOURS = 24.0  # in all
ROLES = ("manager", "train", "match")  # each with its helpers
Blocks = dict[str, list[float]]  # column -> a value for each block of a part


def name(file: Path) -> str:
    """Return the name of a part: when it began."""
    return file.stem.removeprefix("part-")


def part(file: Path) -> dict[str, Any]:
    """Return a part's result from its samples."""
    first, *lines = map(json.loads, file.read_text().splitlines())
    samples = [line for line in lines if "roles" in line]
    ended = next((line for line in lines if "ended" in line), {"ended": samples[-1]["time"], "exits": []})
    return {
        "name": name(file),
        "commit": first.get("commit", "unknown"),
        "goes_on_from": first["origin"],
        "hours": round((ended["ended"] - first["began"]) / 3600, 3),
        "exits": ended["exits"],
        "wal_mb_max": round(max(s["disk"]["wal"] for s in samples), 2),
        "blocks": blocks(samples, first["began"]),
    }


def blocks(samples: Sequence[Mapping[str, Any]], began: float) -> Blocks:
    """Return means over BLOCK seconds, speeds between the ends of successive blocks, and counts at their end."""
    found: Blocks = {}
    before: Mapping[str, float] | None = None
    for number, group in groupby(samples, lambda s: (s["time"] - began) // BLOCK):
        own = [flat(sample) for sample in group]
        last = own[-1]
        row = {key: float(np.mean([each[key] for each in own])) for key in last}
        row |= {key: last[key] for key in ("time", *COUNTS)} | {"wal": max(each["wal"] for each in own)}
        row["minute"] = (number + 1) * BLOCK / 60
        since = before or own[0]
        if last["time"] > since["time"]:
            steps, seconds = last["steps"] - since["steps"], last["time"] - since["time"]
            row["steps_per_second"] = steps / seconds
            row["steps_per_cpu_second"] = steps / max(last["train_cpu"] - since["train_cpu"], 1e-9)
            row["games_per_cpu_second"] = (last["games"] - since["games"]) / max(
                last["match_cpu"] - since["match_cpu"], 1e-9
            )
            for key in COLUMNS:
                found.setdefault(key, []).append(float(f"{row[key]:.5g}") if key not in COUNTS else int(row[key]))
        before = last
    return found


def flat(sample: Mapping[str, Any]) -> dict[str, float]:
    """Return a sample as one row: memory, handles, threads and processor seconds of each role with its helpers."""
    roles, disk = sample["roles"], sample["disk"]
    row = {key: sample[key] for key in ("time", "load", "steps", "games", "matches", "snapshots", "thinned")}
    row |= {key: disk[key] for key in ("database", "wal", "blobs")}
    for role in ROLES:
        own = [roles[each] for each in (role, f"{role}-helper") if each in roles]
        row |= {f"{role}_{key}": sum(each[key] for each in own) for key in ("uss", "rss", "files", "threads", "cpu")}
    row["files"] = sum(row[f"{role}_files"] for role in ROLES)
    row["threads"] = sum(row[f"{role}_threads"] for role in ROLES)
    return row


COUNTS = ("steps", "games", "matches", "snapshots", "thinned")
SLOPES = {
    "manager_uss": "MB", "train_uss": "MB", "match_uss": "MB", "files": "handles", "threads": "threads",
    "database": "MB", "blobs": "MB",
}  # fmt: skip
SPEEDS = ("steps_per_cpu_second", "steps_per_second", "games_per_cpu_second")
COLUMNS = ("minute", *SLOPES, "wal", *SPEEDS, "load", *COUNTS)


def slope(parts: Sequence[Blocks], key: str, logarithm: bool = False) -> dict[str, float] | None:
    """Return the common slope per hour of a column over all parts, with its interval; None with too few blocks."""
    hours, values = [], []
    for each in parts:
        at, y = np.array(each["minute"]) / 60, np.array(each[key])
        use = (at > SETTLING / 60) & ((y > 0) | (not logarithm))
        if use.sum() < 3:
            continue
        y = np.log(y[use]) if logarithm else y[use]
        hours.append(at[use] - at[use].mean())
        values.append(y - y.mean())
    if not hours:
        return None
    x, y = np.concatenate(hours), np.concatenate(values)
    freedom = len(x) - len(hours) - 1
    value = float(x @ y / (x @ x))
    error = math.sqrt(float(((y - value * x) ** 2).sum()) / freedom / float(x @ x)) * float(student.ppf(0.975, freedom))
    low, middle, high = (100 * math.expm1(v) if logarithm else v for v in (value - error, value, value + error))
    return {"per_hour": float(f"{middle:.3g}"), "low": float(f"{low:.3g}"), "high": float(f"{high:.3g}")}


def slopes(parts: Sequence[Blocks]) -> dict[str, dict[str, float] | None]:
    """Return the slopes per hour of memory, handles, threads and disk, with their units."""
    return {f"{key} ({unit})": slope(parts, key) for key, unit in SLOPES.items()}


def report(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what all parts say together."""
    own = [each["blocks"] for each in parts if each["blocks"]]
    hours = sum(each["hours"] for each in parts)
    return {
        "hours": round(hours, 2), "of_hours": HOURS, "parts": len(parts),
        "new_leagues": sum(each["goes_on_from"] == "nothing" for each in parts),
        "restarts_of_the_league": sum(len(each["exits"]) for each in parts),
        "wal_mb_max": max((each["wal_mb_max"] for each in parts), default=0.0),
        "slopes": slopes(own),
        "slopes_of_each_part": {each["name"]: slopes([each["blocks"]]) for each in parts if each["blocks"]},
        "drift_percent": {key: slope(own, key, logarithm=True) for key in SPEEDS},
        "steps": max((b["steps"][-1] for b in own), default=0),
        "rated_games": max((b["games"][-1] for b in own), default=0),
        "snapshots": max((b["snapshots"][-1] for b in own), default=0),
    }  # fmt: skip


def write(result: dict[str, Any], out: Path) -> None:
    """Write the result, a line for each column of blocks, and draw its figure beside it."""
    text, columns = json.dumps(result, indent=1), {}
    for i, each in enumerate(result["parts"]):
        for key, values in each["blocks"].items():
            columns[f'"{i}/{key}"'] = json.dumps(values, separators=(",", ":"))
    marked = [
        {**each, "blocks": {key: f"{i}/{key}" for key in each["blocks"]}} for i, each in enumerate(result["parts"])
    ]
    text = json.dumps({**result, "parts": marked}, indent=1)
    for mark, values in columns.items():
        text = text.replace(f": {mark}", f": {values}", 1)
    out.write_text(text + "\n")
    draw(result, out.with_suffix(".svg"))


def draw(result: Mapping[str, Any], picture: Path) -> None:
    """Draw memory, handles, disk and speed over the hours of all parts; a gap shows a new part."""
    matplotlib.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "soak", "font.size": 8}
    figure, axes = plt.subplots(2, 2, figsize=(8, 4.6), sharex=True, layout="constrained")
    panels = {
        "own memory, MB": {f"{role}_uss": role for role in ROLES},
        "file handles and threads": {"files": "handles", "threads": "threads"},
        "store, MB": {"database": "database", "wal": "WAL, largest", "blobs": "blobs"},
        "steps per second": {"steps_per_cpu_second": "of the learner's processors", "steps_per_second": "by the clock"},
    }  # fmt: skip
    for axis, (title, lines) in zip(axes.flat, panels.items(), strict=True):
        for colour, (key, label) in zip(("#2a6be6", "#d05a2b", "#3a9a5b"), lines.items(), strict=False):
            start = 0.0
            for i, each in enumerate(result["parts"]):
                at = start + np.array(each["blocks"].get("minute", [])) / 60
                axis.plot(at, each["blocks"].get(key, []), color=colour, lw=1.1, label=None if i else label)
                start += each["hours"]
        axis.set(title=title, ylim=(0, None), xlim=(0, None))
        axis.legend(frameon=False, loc="best")
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[1]:
        axis.set_xlabel(f"hours of {HOURS:g}")
    figure.savefig(picture, metadata={"Date": None})
    plt.close(figure)
