"""The page of a league in a real browser: what is seen, read out, typed and clicked."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from league.commands.cli import main
from storage.recordings.recording import to_bytes
from storage.records import League
from storage.store import Store
from tests.dashboards.cars import cars
from tests.league.conftest import free_port
from tests.league.leagues import filled, finish, match
from tests.league.served import Served

playwright = pytest.importorskip("playwright.sync_api")
expect = playwright.expect
expect.set_options(timeout=60_000)  # machines that do other things too


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROBOT_LEAGUE_CACHE", str(folder / "cache"))
        yield _filled(folder)


def _filled(folder: Path) -> Path:
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

    def show(self, tab: str) -> None:
        """A section, by the navigation."""
        self.tab.get_by_role("navigation").get_by_role("link", name=tab, exact=True).click()

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
    seen.show("Ladder")
    before = int(seen.games("blue@4").text_content())
    played(folder, match("blue@4", "red@4", 20, 12))
    expect(seen.games("blue@4")).to_have_text(str(before + 32))
    assert seen.complaints == []
    at = f"http://127.0.0.1:{served.port}"
    assert {url.rpartition("/")[0] for url in seen.asked} <= {at, f"{at}/film"}
    expect(seen.tab.get_by_role("heading", name="Ladder")).to_be_visible()  # where its reader was

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


@pytest.mark.slow
def test_a_pair_is_chosen_by_keyboard_and_its_match_copied(seen, folder):
    seen.context.grant_permissions(["clipboard-read", "clipboard-write"])
    seen.show("Payoff")
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
    seen.show("Payoff")
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


@pytest.mark.slow
def test_axe_finds_nothing_and_figures_take_the_readers_colours(browser, folder, monkeypatch):
    from axe_playwright_python.sync_playwright import Axe

    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit, match="0"):
        main(["report", "-o", "report.html"])
    # The page's own policy lets no other script run, so axe comes in beside it.
    seen = Seen(browser, color_scheme="light", bypass_csp=True)
    seen.tab.goto((folder / "report.html").as_uri())
    tabs = seen.tab.get_by_role("navigation").get_by_role("link").all_text_contents()
    assert len(tabs) == 11
    for tab in tabs:
        seen.show(tab)
        for figure in seen.tab.locator("section:not([hidden]) figure.chart").all():
            figure.scroll_into_view_if_needed()
            figure.locator(".main-svg").first.wait_for()
        if tab == "Payoff":
            seen.choose("blue@4", "red@4")
        found = Axe().run(seen.tab)
        assert found.response["passes"]
        assert found.violations_count == 0, f"{tab}: {found.generate_report()}"
    seen.show("Ratings")
    for scheme, ink, paper in (("light", "#1b1f24", "#ffffff"), ("dark", "#e6e9ed", "#14181d")):
        seen.tab.emulate_media(color_scheme=scheme)
        expect(seen.tab.locator("body")).to_have_css("background-color", rgb(paper))
        expect(seen.tab.locator("#ratings .xtitle").first).to_have_css("fill", rgb(ink))
        for tab in ("Ratings", "Overview"):
            seen.show(tab)
            found = Axe().run(seen.tab, options={"runOnly": ["color-contrast"]})
            assert found.response["passes"]
            assert found.violations_count == 0, found.generate_report()
        seen.show("Ratings")
    assert seen.complaints == []
    assert {url.partition(":")[0] for url in seen.asked} <= {"file", "data"}
    seen.context.close()


def test_it_opens_with_the_answers_and_shows_one_section_at_a_time(seen):
    headings = [each.text_content() for each in seen.tab.get_by_role("heading", level=3).all()]
    assert headings == ["Who leads", "Is it still learning?", "What is wrong?"]
    visible = seen.tab.locator("main > section:not([hidden])")
    assert seen.tab.evaluate("document.documentElement.scrollHeight") <= 900
    expect(visible).to_have_count(1)
    tabs = seen.tab.get_by_role("navigation").get_by_role("link")
    tabs.first.focus()
    expect(tabs.first).to_have_attribute("aria-current", "true")
    seen.tab.keyboard.press("Tab")
    seen.tab.keyboard.press("Tab")
    seen.tab.keyboard.press("Enter")
    expect(visible).to_have_attribute("id", "ladder")
    expect(visible).to_be_focused()
    assert seen.tab.evaluate("scrollY") == 0
    seen.tab.keyboard.press("Tab")  # goes on in the section
    expect(seen.tab.get_by_role("region", name="Ladder, best first")).to_be_focused()
    seen.tab.go_back()
    expect(visible).to_have_attribute("id", "overview")
    seen.tab.get_by_role("link", name="Jobs and errors").click()  # of the card
    expect(visible).to_have_attribute("id", "jobs")
    seen.tab.get_by_role("link", name="To the content").focus()
    seen.tab.keyboard.press("Enter")
    expect(visible).to_have_attribute("id", "jobs")
    seen.tab.evaluate("dispatchEvent(new Event('beforeprint'))")
    expect(visible).to_have_count(11)
    seen.tab.evaluate("dispatchEvent(new Event('afterprint'))")
    expect(visible).to_have_attribute("id", "jobs")
    assert seen.complaints == []


def test_without_scripts_all_sections_are_shown(browser, served):
    seen = Seen(browser, java_script_enabled=False)
    seen.tab.goto(f"http://127.0.0.1:{served.port}/")
    for section in seen.tab.locator("main > section").all():
        expect(section).to_be_visible()
    seen.context.close()


PLAY = """async film => {
    await film.play();
    await new Promise(done => film.addEventListener("timeupdate", done, { once: true }));
    film.pause();
    return [film.videoWidth, film.videoHeight, film.currentTime > 0, film.duration];
}"""


@pytest.mark.slow
def test_films_play_as_served_and_in_a_report(seen, browser, folder, monkeypatch):
    served = seen.tab.locator("#overview video")
    served.wait_for(timeout=120_000)  # it is drawn meanwhile
    *shown, seconds = served.evaluate(PLAY)
    assert shown == [480, 300, True]
    assert seconds == pytest.approx(3, abs=0.2)  # of the match two, and the last picture for one
    assert served.evaluate("film => film.controls && film.muted && film.paused")
    told = seen.tab.locator("#overview .film figcaption").text_content()
    assert told is not None
    assert told.startswith("Newest. Match 2: blue@16 against red@8, win blue, 2.0 s.")
    assert seen.complaints == []

    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit, match="0"):
        main(["report", "-o", "films.html"])
    report = Seen(browser)
    report.tab.goto((folder / "films.html").as_uri())
    film = report.tab.locator("#overview video")
    assert film.evaluate(PLAY)[:3] == [480, 300, True]
    assert report.complaints == []
    assert {url.partition(":")[0] for url in report.asked} <= {"file", "data"}
    report.context.close()


def rgb(colour: str) -> str:
    return f"rgb({', '.join(str(int(colour[i : i + 2], 16)) for i in (1, 3, 5))})"


def test_a_page_takes_the_name_of_the_league_that_is_run_next(browser, tmp_path):
    name = "\u043a\u0443\u0431\u043e\u043a"  # a cup, in letters that no header of HTTP has
    with filled(tmp_path / "league-data") as store:
        running = Served(tmp_path, free_port())
        try:
            seen = Seen(browser)
            seen.tab.goto(f"http://127.0.0.1:{running.port}/")
            expect(seen.tab).to_have_title("League cup")
            store.create_league(League(name, ""))
            store.start_run(name, "", "here", {})
            seen.show("Players")
            expect(seen.tab.locator("#now-0")).to_contain_text(f"League {name}")
            expect(seen.tab).to_have_title(f"League {name}")
            expect(seen.tab.get_by_role("heading", level=1)).to_have_text(f"League {name}")
            assert seen.complaints == []
            seen.context.close()
        finally:
            running.kill()
