"""`league gate`: test whether one snapshot is better than another, ending as early as two error rates allow."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from league.commands.options import HypothesesOptions, Where, parse, positional
from league.commands.progress_bar import report_kernels
from league.config.schema import ConfigError
from league.matches.adhoc_matches import Pairing, pairing, require_two_sides
from matchmaking.ratings.sprt import SequentialTest, SprtResult
from storage.records import Match, PairCounts

ACCEPTED, REJECTED, UNDECIDED = 0, 1, 3
"""Exit codes; 2 means bad input, as in all commands."""
WHAT = """Decide whether snapshot A is better than B by a sequential test on seed pairs. Exit code 0: accepted, A is
better; 1: rejected; 3: undecided after --most episodes. The games are kept and count for ratings."""


def _even(value: int) -> None:
    if value % 2:
        raise ValueError("must be even, half of them with sides swapped")


@dataclass(frozen=True, kw_only=True)
class GateOptions(HypothesesOptions, Where):
    """The two snapshots, and the test."""

    a: str = positional()
    """The snapshot that is said to be better, such as blue@64, or a player, whose newest it is."""
    b: str = positional()
    """The snapshot or player that A is compared with."""
    most: int = field(default=10_000, metadata={"low": 2})
    """Episodes after which it is left undecided."""
    batch: int = field(default=128, metadata={"low": 2, "high": 2**20, "valid": _even})
    """Episodes between two looks at the test; fewer decide earlier, more use a machine better."""
    format: Literal["table", "json"] = "table"
    """Text for people, json for programs."""


def gate(args: list[str]) -> int:
    """Play until the test is decided."""
    options = parse(GateOptions, args, "gate", WHAT)
    with options.open() as opened:
        require_two_sides(opened, "a gate")
        found = pairing(opened, options.a, options.b)
        _refuse(found)
        test, text = options.test(), options.format == "table"
        episodes, pairs, stands = decide(found, test, options.batch, options.most, _line if text else lambda _: None)
    if text:
        print(_verdict(found, stands, episodes, sum(pairs)))
    else:
        told = {"a": found.a.name, "b": found.pair[1], "episodes": episodes, "pentanomial": list(pairs)}
        print(json.dumps(told | stands.for_json(), indent=2))
    return {"accept": ACCEPTED, "reject": REJECTED, "continue": UNDECIDED}[stands.decision]


def _line(text: str) -> None:
    print(text, flush=True)  # a batch may take minutes


def _refuse(found: Pairing) -> None:
    """Raise ConfigError if the test does not apply to the pair.

    Seed pairs need both sides. For unlike rosters the trinomial test would be possible, but ½ is not an even score
    there: the test would only find the easier side.
    """
    a, b = found.pair
    if found.b is None or found.a.digest == found.b.digest:
        raise ConfigError((), f"{a} and {b} are the same policy: name two that differ")
    if not found.swaps:
        verdict = "cannot swap sides, and an even score between unlike sides says nothing of who is better"
        raise ConfigError((), f"{a} and {b} {verdict}: compare two of one side by `league ratings`")


def decide(
    found: Pairing, test: SequentialTest, batch: int, most: int, tell: Callable[[str], None]
) -> tuple[int, PairCounts, SprtResult]:
    """Play batches until the test decides, or another batch would exceed `most` episodes.

    Returns the episodes, the seed pairs and the state of the test; `tell` takes a line after each batch.

    The random seed of each batch is determined by the league's seed, the pair, the test and the batch's number. It
    identifies batches that are already in the store, so a test that was killed continues, and a test that was decided
    is reported again. Other games of the two do not count: they may be the reason for which the test was requested.
    """
    evaluator, (a, b) = found.evaluator(min(batch, most - most % 2)), found.pair
    tell(f"Is {a} better than {b}? Elo {test.elo0:g} against {test.elo1:g} ({test.model}), bounds {_bounds(test)}.")
    while True:
        played = batches(found.filed("gate", evaluator.key), found, test)
        episodes, pairs = sum(map(_episodes, played)), paired(played)
        stands = test.result(pairs)
        if played:
            tell(f"{episodes:,} episodes, {_pairs(pairs)}: LLR {stands.llr:.3f} in {_bounds(test)}")
        if stands.decision != "continue" or episodes + 2 * evaluator.each > most:
            return episodes, pairs, stands
        with report_kernels():
            found.file(evaluator, "gate", seed(found, test, len(played)))


def seed(found: Pairing, test: SequentialTest, number: int) -> int:
    """Return the random seed of a test's batch, counted from 0."""
    return found.seed("gate", test.elo0, test.elo1, test.alpha, test.beta, test.model, number)


def batches(filed: Mapping[int, Match], found: Pairing, test: SequentialTest) -> list[Match]:
    """Return the batches of a test that have been played, in order."""
    played: list[Match] = []
    while (match := filed.get(seed(found, test, len(played)))) is not None:
        played.append(match)
    return played


def paired(played: list[Match]) -> PairCounts:
    """Sum the seed pairs of several batches."""
    return (
        PairCounts(*(sum(counts) for counts in zip(*(m.pairs for m in played), strict=True)))
        if played
        else PairCounts()
    )


def _episodes(match: Match) -> int:
    return match.wins + match.draws + match.losses + match.voids


def _pairs(pairs: PairCounts) -> str:
    ll, ld, dd, dw, ww = pairs
    return f"seed pairs {ll} LL, {ld} LD, {dd} DD or WL, {dw} DW, {ww} WW"


def _bounds(test: SequentialTest) -> str:
    return f"({test.lower:.3f}, {test.upper:.3f})"


def _verdict(found: Pairing, stands: SprtResult, episodes: int, pairs: int) -> str:
    (a, b), by = found.pair, f"by {episodes:,} episodes in {pairs:,} seed pairs"
    verdict = {
        "accept": f"Accepted: {a} is better than {b}, {by}.",
        "reject": f"Rejected: {a} is not better than {b}, {by}.",
        "continue": f"Undecided: {episodes:,} episodes do not tell whether {a} is better than {b}; --most allows more.",
    }[stands.decision]
    if stands.elo != stands.elo:
        return f"{verdict} No pair of them was sound: `league matches` counts the void ones."
    ends = f"95 % interval {stands.low:+.0f} to {stands.high:+.0f}"
    return f"{verdict} Measured: {stands.elo:+.0f} Elo ({ends}), which a test that stops early overstates."
