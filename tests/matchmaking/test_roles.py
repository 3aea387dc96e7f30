"""Roles as records, and whom a main exploiter meets."""

import numpy as np
import pytest

from matchmaking.opponents import Opponents, exploit
from matchmaking.roles import FIXED, LEAGUE_EXPLOITER, MAIN, MAIN_EXPLOITER, Role, check_roles, role_named

OTHERWISE = Opponents("uniform")


def test_a_declared_role_differs_from_the_built_in_one_in_what_it_says():
    declared = [Role("main_exploiter", timeout=5), Role("veteran", Opponents("pfsp"), timeout=9, reset="main")]
    hunter, veteran = (role_named(role.name, declared, OTHERWISE) for role in declared)
    assert (hunter.timeout, hunter.win_rate, hunter.meets, hunter.reset) == (5, 0.7, ("main",), "initial")
    assert hunter.opponents == MAIN_EXPLOITER.opponents
    assert (veteran.opponents, veteran.reset, veteran.win_rate) == (Opponents("pfsp"), "main", None)
    assert role_named("main", declared, OTHERWISE).opponents == OTHERWISE
    assert not role_named("main", declared, OTHERWISE).has_generations
    assert [role.learns for role in (MAIN, MAIN_EXPLOITER, FIXED)] == [True, True, False]


@pytest.mark.parametrize(
    ("declared", "used", "says"),
    [
        ((), ["boss"], "no role 'boss'; use one of main, main_exploiter, league_exploiter, fixed, or declare"),
        ((Role("a"), Role("a")), [], "two are called a"),
        ((Role("a", meets=("b",)),), [], "a meets b, and there are main, main_exploiter, league_exploiter, fixed, a"),
        ((Role("a", win_rate=0.7),), [], "a has a win_rate and no timeout"),
        ((Role("a", reset="initial"),), [], "a has a reset, and no timeout"),
    ],
)
def test_roles_that_contradict_themselves_are_refused(declared, used, says):
    with pytest.raises(ValueError, match=says):
        check_roles(declared, used)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("win_rate", 1.0),
        ("win_rate", 0.0),
        ("timeout", 0),
        ("reset", "now"),
        ("reset_chance", 1.5),
        ("shaping_steps", -1),
    ],
)
def test_a_setting_out_of_bounds_is_refused_by_its_name(field, value):
    with pytest.raises(ValueError, match=f"^{field}: "):
        Role("a", **{field: value})


def test_whether_it_begins_anew_hangs_on_seed_name_and_iteration_alone():
    found = [LEAGUE_EXPLOITER.reset_after(1, "red", i) for i in range(2000)]
    assert found == [LEAGUE_EXPLOITER.reset_after(1, "red", i) for i in range(2000)]
    assert 0.2 < np.mean(found) < 0.3
    assert found != [LEAGUE_EXPLOITER.reset_after(1, "blue", i) for i in range(2000)]
    assert all(MAIN_EXPLOITER.reset_after(1, "red", i) for i in range(20))
    assert not any(MAIN.reset_after(1, "red", i) for i in range(20))


def test_a_main_exploiter_meets_the_newest_or_the_past_of_who_is_too_strong_for_it():
    players = ["a", "b", "a", "b", "a"]
    found = exploit(np.array([0.5, 0.1, 0.9, 0.2, 0.11]), players)
    assert found.past.tolist() == [0, 0, 0, 0.5, 0.5]
    found = exploit(np.array([0.5, 0.1, 0.9, 0.2, 0.1]), players)
    x = np.array([0.5, 0.9, 0.1])
    assert found.past[[0, 2, 4]] == pytest.approx(0.5 * x * (1 - x) / (x * (1 - x)).sum())
    assert found.past[[1, 3]].tolist() == [0, 0.5]
    assert found.why == "a its past, because it is beaten in 10 %; b as it was frozen last"
