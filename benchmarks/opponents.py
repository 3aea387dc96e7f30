"""How long matchmaking takes: probabilities over many policies, and the opponents of all worlds drawn by them.

    python benchmarks/opponents.py [--policies 1000] [--worlds 4096] [--repeats 50]

Median and 95th percentile in milliseconds, of the rules that read win rates; of the mixtures of a payoff table, which
are solved once a turn, for 50 and 200 snapshots.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from matchmaking.equilibrium import nash
from matchmaking.meta import alpharank
from matchmaking.opponents import alphastar, by_quality, delta_uniform, draw, gaussian, pfsp


def timed(action: Callable[[], object], repeats: int) -> dict[str, float]:
    action()
    took = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        took.append(1e3 * (time.perf_counter() - began))
    return {"median_ms": round(float(np.median(took)), 3), "p95_ms": round(float(np.quantile(took, 0.95)), 3)}


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    options.add_argument("--policies", type=int, default=1000)
    options.add_argument("--worlds", type=int, default=4096)
    options.add_argument("--repeats", type=int, default=50)
    asked = options.parse_args()
    rng = np.random.default_rng(0)
    n, x, own = asked.policies, rng.random(asked.policies), np.arange(asked.policies) % 2 == 0

    def mixed() -> np.ndarray:
        mixture = alphastar(x, 0.5, own, ~own)
        whole = np.append(mixture.past, mixture.present)
        return whole / whole.sum()

    rules: dict[str, Callable[[], np.ndarray]] = {
        "delta_uniform": partial(delta_uniform, n, 0.5), "pfsp": partial(pfsp, x), "gaussian": partial(gaussian, x),
        "openai_five": partial(by_quality, x), "alphastar": mixed,
    }  # fmt: skip
    found: dict[str, object] = {"policies": n, "worlds": asked.worlds}
    for name, rule in rules.items():
        found[name] = timed(lambda rule=rule: draw(rule(), asked.worlds, rng), asked.repeats)
    for size in (50, 200):
        game = rng.normal(size=(size, size))
        found[f"nash_{size}"] = timed(lambda game=game: nash(game - game.T), 3)
        found[f"alpharank_{size}"] = timed(lambda game=game: alpharank(game - game.T), 3)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
