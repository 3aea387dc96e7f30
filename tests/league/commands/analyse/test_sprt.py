"""`league sprt` with counts that are none."""

import pytest

from tests.league.conftest import said


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((), "league sprt needs --pentanomial LL,LD,DD,DW,WW, five counts: see league sprt --help"),
        (("--pentanomial", "1", "2", "3"), "must be five counts, LL LD DD DW WW, not 3"),
        (("--pentanomial", "1,2,3,4,-5"), "must be at least 0"),
    ],
)
def test_what_is_no_five_counts_is_refused_in_one_line(args, says, capsys):
    code, out, err = said(capsys, "sprt", *args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err
