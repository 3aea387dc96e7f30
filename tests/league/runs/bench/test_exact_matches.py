"""Exact matches between entries of poker and between a player and its past: tables, means over seeds, losses."""

import numpy as np
import pytest

from experiments import exact_matches
from league.matches.exact_exploitability import KnownGame
from league.runs.bench import entry_file
from matchmaking.extensive_games.sequence_form import SequenceForm
from scripts.record import ROOT

ENTRIES = ROOT / "benchmarks" / "entries"


@pytest.fixture(scope="module")
def known() -> KnownGame:
    """Kuhn poker."""
    return KnownGame("kuhn-poker")


def test_the_tables_of_entries_are_read_in_the_order_of_the_game(known):
    form = SequenceForm(known.rules)
    plans = exact_matches.entered(known, form, ENTRIES)
    told = {
        entry["name"]: [row["exploitability"] for row in entry["rows"]]
        for entry in entry_file.folder(ENTRIES).values()
        if entry["task"] == "t0-kuhn-poker-v1"
    }
    assert {name: [form.exploitability(each) for each in of] for name, of in plans.items()} == {
        name: pytest.approx(figures, abs=1e-5) for name, figures in told.items()
    }


def test_who_always_bets_wins_a_chip_of_who_always_passes(known):
    form = SequenceForm(known.rules)
    bets, passes = (form.plans({key: np.eye(2)[choice] for key in known.known}) for choice in (1, 0))
    found = exact_matches.wins(form, {"bet": [bets], "pass": [passes, passes]})
    # Whoever passes folds to every bet: one chip in each seat.
    assert found == {"bet against pass": {"mean": 1.0, "lowest": 1.0, "highest": 1.0, "of": 2}}


def test_a_method_forgets_by_seed_over_both_players():
    pasts = {1: ([1.0, -1.0], [1.0, 0.0]), 2: ([2.0, 3.0], [4.0, 5.0])}
    rows = [{"method": "latest", "seed": seed, "past": past} for seed, two in pasts.items() for past in two]
    assert exact_matches.forgets(rows) == {
        "latest": {
            "seeds": [1, 2],
            "share that beats the newest": {"mean": 0.125, "lowest": 0.0, "highest": 0.25, "of": 2},
            "whole": {"mean": 1.875, "lowest": 0.25, "highest": 3.5, "of": 2},
            "strongest": {"mean": 1.25, "lowest": -0.5, "highest": 3.0, "of": 2},
        }
    }
