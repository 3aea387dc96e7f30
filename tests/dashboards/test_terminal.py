import pytest

from dashboards.terminal import progress_bar, sparkline, styles


def test_a_line_of_blocks_goes_from_its_lowest_to_its_highest():
    assert sparkline([0, 1, 2, 3, 4, 5, 6, 7], 0, 7) == "▁▂▃▄▅▆▇█"
    assert sparkline([0.5], 0, 1) == "▅"
    assert sparkline([-9, 9], 0, 1) == "▁█"
    assert sparkline([3, 3], 3, 3) == "▁▁"
    assert sparkline([], 0, 1) == ""


def test_of_many_values_neighbours_are_one_block():
    assert sparkline([0.0, 1.0] * 8, 0, 1) == "▅" * 8
    assert len(sparkline([1.0] * 1001, 0, 1)) == 8


@pytest.mark.parametrize(("share", "text"), [(0, "─" * 20 + " 0 %"), (0.5, "━" * 10 + "─" * 10 + " 50 %")])
def test_a_gauge_tells_how_much_is_done(share, text):
    assert progress_bar(share) == text


def test_a_gauge_is_full_when_all_is_done_and_not_before():
    assert progress_bar(0.9999) == "━" * 19 + "─ 99 %"
    assert progress_bar(1.0) == progress_bar(1.2) == "━" * 20 + " 100 %"


def test_owners_have_colours_by_their_order():
    assert styles(["blue", "red", "green", "red"]) == {"blue": "bright_blue", "red": "bright_red", "green": "green"}
    assert styles(["swarm", "guards"])["swarm"] == "bright_blue"
    assert len(styles(str(i) for i in range(9))) == 9
