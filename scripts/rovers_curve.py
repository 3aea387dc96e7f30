"""Draw the result of `experiments/rovers.py`: score by training time against scripts and the initial snapshot.

python -m scripts.rovers_curve experiments/results/rovers-2v2-10min-h100.json docs/pictures/rovers-2v2-10min.png
"""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

AGAINST = {"initial": "its own initial snapshot", "centre-holder": "centre-holder", "pusher": "pusher"}
COLOURS = {"initial": "#8a8f98", "centre-holder": "#e0a020", "pusher": "#2a6be6"}


def main() -> None:
    """Read the result and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, help="the JSON")
    parser.add_argument("picture", type=Path)
    args = parser.parse_args()
    result = json.loads(args.result.read_text())
    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    for player, style in (("blue", "-"), ("red", "--")):
        points = [p for p in result["curve"] if p["snapshot"].startswith(f"{player}@") and p["seconds"]]
        for key, label in AGAINST.items():
            seconds, scores = [p["seconds"] for p in points], [p[key] for p in points]
            middle = [s["score"] for s in scores]
            error = [s["score"] - s["low"] for s in scores], [s["high"] - s["score"] for s in scores]
            name = label if style == "-" else None
            axis.errorbar(seconds, middle, error, color=COLOURS[key], ls=style, lw=1.2, capsize=2, label=name)
    axis.axhline(0.85, color="grey", lw=0.8, ls=":")
    axis.set(xscale="log", ylim=(0, 1.02), xlabel="seconds of training", ylabel="score against")
    axis.set_xticks([2, 5, 10, 30, 60, 120, 300, 600], ["2", "5", "10", "30", "60", "120", "300", "600"])
    axis.minorticks_off()
    axis.legend(title="blue, red dashed; 95 % intervals", loc="lower right", frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(args.picture, dpi=120)


if __name__ == "__main__":
    main()
