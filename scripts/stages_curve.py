"""Draw the results of `experiments/stages.py`: success by training time, a panel for each file.

python -m scripts.stages_curve docs/pictures/stages.png experiments/results/walk-h200.json ...
"""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

COLOURS = {"blue": "#2a6be6", "red": "#e03833"}
COLUMNS = 4
AGAINST = {"initial": "the other side's first"}


def main() -> None:
    """Read the results and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("results", type=Path, nargs="+", help="JSON files, a panel each")
    args = parser.parse_args()
    files = args.results
    columns = min(len(files), COLUMNS)
    rows = -(-len(files) // columns)
    size = 4 * columns, 3.6 * rows
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", sharey=True, squeeze=False)
    for axis, file in zip(axes.flat, files, strict=False):
        panel(axis, json.loads(file.read_text()), file.stem)
    for axis in axes.flat[len(files) :]:
        axis.remove()
    figure.savefig(args.picture, dpi=120)


def panel(axis: plt.Axes, result: dict, title: str) -> None:
    """Draw one stage: a line for each seed and player."""
    for seed in result["seeds"]:
        for player, colour in COLOURS.items():
            points = [p for p in seed["curve"] if p["snapshot"].startswith(f"{player}@") and p["seconds"]]
            if not points:
                continue
            scores = [p["score"] for p in points]
            error = [p["score"] - p["low"] for p in points], [p["high"] - p["score"] for p in points]
            seconds = [p["seconds"] for p in points]
            axis.errorbar(seconds, scores, error, color=colour, alpha=0.7, capsize=2, lw=1)
    against = result["seeds"][0]["against"]
    seeds = len(result["seeds"])
    axis.axhline(result["asked"], color="grey", lw=0.8, ls="--")
    axis.set(
        xscale="log", ylim=(0, 1.02), xlabel="seconds of training",
        ylabel=f"score against {AGAINST.get(against, against)}" if against else "share that succeeds",
        title=f"{title}: {seeds} seed{'s' * (seeds > 1)}",
    )  # fmt: skip
    ticks = [2, 5, 10, 30, 60, 120, 240, 480]
    axis.set_xticks(ticks, list(map(str, ticks)))
    axis.minorticks_off()
    axis.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
