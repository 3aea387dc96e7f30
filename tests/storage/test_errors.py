"""Messages of errors: short, however much a store holds."""

from storage.errors import UnknownName


def test_an_unknown_name_lists_some_names_in_the_order_of_their_numbers():
    known = [f"blue@{2**k}" for k in range(8)]
    assert str(UnknownName("snapshot", "blue@65", known)) == (
        "There is no snapshot 'blue@65' here; there is: blue@1, blue@2, blue@4, blue@8, blue@16, blue@32, blue@64,"
        " blue@128. Did you mean 'blue@64'?"
    )


def test_an_unknown_name_among_thousands_gets_one_short_line():
    told = str(UnknownName("snapshot", "red@4100", [f"red@{k}" for k in range(4000)]))
    assert len(told) < 300
    assert "red@0, red@1, red@2," in told
    assert "and 3,980 more. Did you mean" in told


def test_a_name_may_begin_with_a_number():
    assert "1, 2, 10, a2, a10" in str(UnknownName("job", "3", ["10", "a10", "2", "a2", "1"]))
