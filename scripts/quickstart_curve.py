"""Draw the result of `benchmarks/quickstart.py`: score against the initial snapshot by training time, with intervals.

python -m scripts.quickstart_curve benchmarks/results/quickstart-cpu.json docs/pictures/quickstart.png
"""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt


def main() -> None:
    """Read the result and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, help="the JSON")
    parser.add_argument("picture", type=Path)
    args = parser.parse_args()
    result = json.loads(args.result.read_text())
    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    for seed in result["seeds"]:
        for player, colour in (("blue", "#2a6be6"), ("red", "#e03833")):
            points = [p for p in seed["curve"] if p["player"] == player]
            seconds, score = [p["seconds"] for p in points], [p["score"] for p in points]
            below = [p["score"] - p["low"] for p in points]
            above = [p["high"] - p["score"] for p in points]
            label = player if seed is result["seeds"][0] else None
            axis.errorbar(seconds, score, (below, above), color=colour, alpha=0.7, capsize=2, lw=1, label=label)
    axis.axhline(0.5, color="grey", lw=0.8, ls=":")
    axis.axhline(0.9, color="grey", lw=0.8, ls="--")
    axis.set(xscale="log", ylim=(0.45, 1.01), xlabel="seconds of training", ylabel="score against its initial snapshot")
    axis.set_xticks([2, 5, 10, 30, 60, 120, 300], ["2", "5", "10", "30", "60", "120", "300"])
    axis.minorticks_off()
    axis.legend(title=f"{len(result['seeds'])} seeds, 95 % intervals", loc="lower right", frameon=False)
    axis.spines[["top", "right"]].set_visible(False)
    args.picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.picture, dpi=120)


if __name__ == "__main__":
    main()
