"""Time of opponent sampling: probabilities over many policies, and the opponents of all groups of worlds drawn by them.

    python -m benchmarks.opponents [--policies 1000] [--groups 8] [--repeats 50]

Prints median and 95th percentile in milliseconds: of the rules that read win rates, and of the mixtures of a payoff
table for 50 and 200 snapshots, which a league solves once a turn.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from matchmaking.metagame.alpharank import alpharank
from matchmaking.metagame.nash import nash
from matchmaking.opponents import alphastar, by_quality, delta_uniform, draw, gaussian, pfsp
from scripts.record import make_parser, report, run_info


def timed(action: Callable[[], object], repeats: int) -> dict[str, float]:
    """Return the median and 95th percentile of `action()` in ms, after one call that is not counted."""
    action()
    took = []
    for _ in range(repeats):
        began = time.perf_counter()
        action()
        took.append(1e3 * (time.perf_counter() - began))
    return {"median_ms": round(float(np.median(took)), 3), "p95_ms": round(float(np.quantile(took, 0.95)), 3)}


def main() -> None:
    """Measure every rule and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--policies", type=int, default=1000)
    parser.add_argument("--groups", type=int, default=8, help="of a learner's worlds")
    parser.add_argument("--repeats", type=int, default=50)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    n, x, own = args.policies, rng.random(args.policies), np.arange(args.policies) % 2 == 0

    def mixed() -> np.ndarray:
        mixture = alphastar(x, 0.5, own, ~own)
        whole = np.append(mixture.past, mixture.present)
        return whole / whole.sum()

    rules: dict[str, Callable[[], np.ndarray]] = {
        "delta_uniform": partial(delta_uniform, n, 0.5), "pfsp": partial(pfsp, x), "gaussian": partial(gaussian, x),
        "openai_five": partial(by_quality, x), "alphastar": mixed,
    }  # fmt: skip
    result: dict[str, object] = {"policies": n, "groups": args.groups}
    names, groups = [f"red@{i}" for i in range(n + 1)], [f"1/blue/1/{k}/0" for k in range(args.groups)]
    for name, rule in rules.items():
        result[name] = timed(lambda rule=rule: draw(rule(), names, groups), args.repeats)
    for size in (50, 200):
        game = rng.normal(size=(size, size))
        result[f"nash_{size}"] = timed(lambda game=game: nash(game - game.T), 3)
        result[f"alpharank_{size}"] = timed(lambda game=game: alpharank(game - game.T), 3)
    report({**run_info(args.commit), **result}, args.out)


if __name__ == "__main__":
    main()
