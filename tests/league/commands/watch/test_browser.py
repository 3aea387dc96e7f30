"""The page of a league in a real browser: what is seen, read out, typed and clicked."""

from collections.abc import Iterator

import pytest

from league.commands.cli import main
from storage.recordings.recording import to_bytes
from storage.store import Store
from tests.dashboards.cars import cars
from tests.league.leagues import filled, finish, match
from tests.league.served import Served

playwright = pytest.importorskip("playwright.sync_api")
expect = playwright.expect
expect.set_options(timeout=60_000)  # machines that do other things too


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    with filled(folder / "league-data") as store:
        film = store.blobs.put(to_bytes(cars()))
        finish(store, matches=[match("blue@1", "red@1", 48, 16), match("red@1", "blue@1", 8, 24, recording=film)])
        finish(store, matches=[match("blue@4", "red@4", 48, 16), match("blue@4", "blue@0", 60, 4)])
    return folder


@pytest.fixture(scope="module")
def served(folder, port) -> Iterator[Served]:
    running = Served(folder, port)
    yield running
    running.kill()


class Seen:
    """A page in a tab of its own, with all that it asked for and complained of."""

    def __init__(self, browser, **context):
        self.context = browser.new_context(**context)
        self.tab = self.context.new_page()
        self.asked: list[str] = []
        self.complaints: list[str] = []
        self.tab.on("request", lambda request: self.asked.append(request.url))
        self.tab.on("console", lambda message: self.complaints.append(message.text))
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))

    def games(self, snapshot: str):
        """The cell of a snapshot's games in the ladder."""
        row = self.tab.get_by_role("region", name="Ladder, best first").get_by_role("row").filter(
            has=self.tab.get_by_role("rowheader", name=snapshot, exact=True)
        )  # fmt: skip
        return row.get_by_role("cell").nth(3)

    @property
    def pairs(self):
        """Where a reader chooses a pair."""
        return self.tab.get_by_role("group", name="Matches of a pair")

    def choose(self, *names: str) -> None:
        """A pair by the two lists."""
        for chooser, name in zip(self.pairs.get_by_role("combobox").all(), names, strict=True):
            chooser.select_option(name)


@pytest.fixture
def seen(browser, served) -> Iterator[Seen]:
    """The page as it is served."""
    found = Seen(browser)
    found.tab.goto(f"http://127.0.0.1:{served.port}/")
    yield found
    found.context.close()


def played(folder, *matches) -> None:
    with Store.open(folder / "league-data") as store:
        finish(store, matches=matches)


def test_it_changes_without_a_reload_and_outlives_its_server(seen, served, folder):
    seen.tab.evaluate("window.mine = true")  # a reload would forget it
    before = int(seen.games("blue@4").text_content())
    played(folder, match("blue@4", "red@4", 20, 12))
    expect(seen.games("blue@4")).to_have_text(str(before + 32))
    assert seen.complaints == []
    assert {url.rpartition("/")[0] for url in seen.asked} == {f"http://127.0.0.1:{served.port}"}

    served.kill()
    status = seen.tab.get_by_role("status")
    expect(status).to_have_text("The server does not answer; the page goes on when it does.")
    played(folder, match("blue@4", "red@4", 20, 12))
    served.begin()
    expect(seen.games("blue@4")).to_have_text(str(before + 64))
    expect(status).to_have_text("Up to date.")
    assert seen.tab.evaluate("window.mine")
    assert all("ERR_" in text for text in seen.complaints)  # what the browser says of a server that is gone


def arrow_to(chooser, name: str) -> None:
    for _ in chooser.get_by_role("option").all():
        if chooser.input_value() != name:
            chooser.press("ArrowDown")
    expect(chooser).to_have_value(name)


def test_a_pair_is_chosen_by_keyboard_and_its_match_copied(seen, folder):
    seen.context.grant_permissions(["clipboard-read", "clipboard-write"])
    first, second = seen.pairs.get_by_role("combobox").all()
    first.focus()
    arrow_to(first, "blue@1")
    seen.tab.keyboard.press("Tab")
    expect(second).to_be_focused()
    arrow_to(second, "red@1")
    rows = seen.pairs.get_by_role("row")
    expect(rows).to_have_count(3)
    assert rows.nth(1).get_by_role("cell").all_text_contents()[:4] == ["2", "red@1", "blue@1", "8-0-24"]
    assert rows.nth(2).get_by_role("cell").all_text_contents()[:4] == ["1", "blue@1", "red@1", "48-0-16"]
    seen.tab.keyboard.press("Tab")  # the table, which can be scrolled
    seen.tab.keyboard.press("Tab")

    def recording(answer) -> bool:
        return answer.url.endswith("/match/2.rrd")

    # Of the context: a page that has only just opened may have its answer before anybody listens to the page.
    with (
        seen.context.expect_event("response", recording, timeout=120_000) as drawn,
        seen.context.expect_page() as opened,
    ):
        seen.tab.keyboard.press("Enter")
    assert drawn.value.status == 200  # rerun's viewer may read it
    opened.value.close()
    seen.tab.keyboard.press("Tab")
    seen.tab.keyboard.press("Enter")
    expect(seen.tab.get_by_role("status")).to_have_text("Copied: league watch 2")
    assert seen.tab.evaluate("navigator.clipboard.readText()") == "league watch 2"
    played(folder, match("blue@1", "red@1", 20, 12))
    expect(rows).to_have_count(4)  # what was chosen is kept, and follows too
    assert seen.complaints == []


def test_a_click_on_a_cell_shows_its_matches(seen):
    plot = seen.tab.locator("#payoff .plot")
    plot.scroll_into_view_if_needed()
    plot.locator(".heatmaplayer image").wait_for()
    place = plot.evaluate("""plot => {
        const { xaxis, yaxis } = plot._fullLayout, box = plot.getBoundingClientRect();
        const pixel = (axis, name) => axis._offset + axis.c2p(axis._categories.indexOf(name));
        return [box.x + pixel(xaxis, "blue@0"), box.y + pixel(yaxis, "blue@4")];
    }""")
    seen.tab.mouse.move(*place)
    seen.tab.mouse.click(*place)
    expect(seen.pairs.get_by_role("table")).to_contain_text("blue@4 and blue@0: 1 batch")
    assert [each.input_value() for each in seen.pairs.get_by_role("combobox").all()] == ["blue@4", "blue@0"]
    assert seen.complaints == []


def test_axe_finds_nothing_and_figures_take_the_readers_colours(browser, folder, monkeypatch):
    from axe_playwright_python.sync_playwright import Axe

    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit, match="0"):
        main(["report", "-o", "report.html"])
    # The page's own policy lets no other script run, so axe comes in beside it.
    seen = Seen(browser, color_scheme="light", bypass_csp=True)
    seen.tab.goto((folder / "report.html").as_uri())
    for figure in seen.tab.locator("figure").all():
        figure.scroll_into_view_if_needed()
        figure.locator(".main-svg").first.wait_for()
    seen.choose("blue@4", "red@4")
    for scheme, ink, paper in (("light", "#1b1f24", "#ffffff"), ("dark", "#e6e9ed", "#14181d")):
        seen.tab.emulate_media(color_scheme=scheme)
        expect(seen.tab.locator("body")).to_have_css("background-color", rgb(paper))
        expect(seen.tab.locator(".xtitle").first).to_have_css("fill", rgb(ink))
        found = Axe().run(seen.tab, options=None if scheme == "light" else {"runOnly": ["color-contrast"]})
        assert found.response["passes"]
        assert found.violations_count == 0, found.generate_report()
    assert seen.complaints == []
    assert {url.partition(":")[0] for url in seen.asked} <= {"file", "data"}
    seen.context.close()


def rgb(colour: str) -> str:
    return f"rgb({', '.join(str(int(colour[i : i + 2], 16)) for i in (1, 3, 5))})"
