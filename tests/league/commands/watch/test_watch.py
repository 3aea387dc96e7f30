"""`league watch`: which match it shows, as whom, and what it says where there is none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from league.commands.analyse.tables import matches
from league.commands.store.verify import verify
from league.commands.watch.watch import watch
from league.queries.match_players import players_of
from league.queries.query import Open
from league.queries.recordings import RecordingQuery, chosen, following
from storage.errors import StorageError
from storage.maintenance.thinning import RetentionPolicy
from storage.recordings.recording import Recording, to_bytes
from storage.records import COUNT_COLUMNS, RATED_PURPOSES
from storage.store import Store
from tests.dashboards.cars import cars
from tests.league.leagues import C, filled, finish, match
from tests.league.packs import ran, refused


def recorded(played: Recording, sides: tuple[str, str], first: float = 1.0) -> Recording:
    """That match as one of these two snapshots, of which the first one scored so."""
    outcome = "draw" if first == 0.5 else f"{sides[first < 0.5]} wins as {played.header.teams[first < 0.5]}"
    header = replace(played.header, sides=sides, score=(first, 1 - first), outcome=outcome, league="cup")
    return replace(played, header=header)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """Red's newest is the best, blue's first the worst; once that one has won a recorded episode nevertheless."""
    folder, played = tmp_path_factory.mktemp("watched") / "league-data", cars()
    with filled(folder) as store:
        put = store.blobs.put
        games = [
            match("red@4", "blue@4", 90, 30, recording=put(to_bytes(
                recorded(played, ("red@4", "blue@4")), recorded(played, ("blue@4", "red@4"), 0.0)))),
            match("red@4", "blue@0", 118, 2, recording=put(to_bytes(recorded(played, ("blue@0", "red@4"))))),
            match("red@4", "red@0", 110, 10, recording=put(to_bytes(recorded(played, ("red@4", "red@0"))))),
            match("blue@4", "blue@0", 100, 20),
            match("red@0", "blue@0", 64, 56, recording=put(to_bytes(recorded(played, ("red@0", "blue@0"))))),
        ]  # fmt: skip
        finish(store, matches=games[:2])
        finish(store, matches=games[2:])
    return folder


@pytest.fixture
def learning(tmp_path) -> Path:
    """Red's newest has beaten blue's; then an episode of training was recorded, in which blue won."""
    with filled(tmp_path / "league-data") as store:
        put, played = store.blobs.put, cars()
        games = [
            put(to_bytes(recorded(played, ("red@4", "blue@4")))),
            put(to_bytes(recorded(played, ("blue@5", "red@5")))),
        ]
        finish(store, matches=[match("red@4", "blue@4", 90, 30, recording=games[0])])
        finish(store, matches=[match("blue@4", "red@4", 2, 0, recording=games[1], purpose="training")])
    return tmp_path / "league-data"


def test_an_episode_of_training_is_shown_as_what_it_is(learning, capsys, tmp_path):
    with Open(Store.open(learning)) as opened:
        assert [chosen(opened, w).id for w in (RecordingQuery(), RecordingQuery(player="red"))] == [2, 2]
        assert [
            chosen(opened, w).id for w in (RecordingQuery(best=True), RecordingQuery(between=("blue@4", "red@4")))
        ] == [1, 1]
        with pytest.raises(StorageError, match="In no recorded match"):
            chosen(opened, RecordingQuery(upset=True))
        blue, red = players_of(opened, opened.store.matches("cup")[1], ("blue@5", "red@5"))
        assert blue.label == "blue@5 · main"  # nobody has rated it
        known = players_of(opened, opened.store.matches("cup")[0], ("blue@4", "red@4"))
        assert [blue.colour, red.colour] == [who.colour for who in known]
        assert list(opened.matches()["a"]) == ["red@4", "blue@4+"]
        (row,) = np.reshape(opened.store.totals("cup", RATED_PURPOSES)[C].counts, (-1, len(COUNT_COLUMNS)))
        assert sum(row[:3]) == 120  # nothing of training
    assert watch(["--store", str(learning), "--save", str(tmp_path / "it.rrd")]) == 0
    assert capsys.readouterr().out.startswith("Training 2: blue@5 against red@5, blue@5 wins as blue, ")
    assert matches(["--store", str(learning)]) == 0
    assert "training" in capsys.readouterr().out.splitlines()[-1]
    verify(["--store", str(learning)])
    assert "recording" not in capsys.readouterr().out.partition("problem")[2]  # the policies of this store are none
    with Store.open(learning) as store:
        store.thin(store.find_removable(RetentionPolicy(-1.0, {}, recordings=0)))
        assert [m.recording for m in store.matches("cup")] == [None, None]


@pytest.mark.parametrize(
    ("wish", "number"),
    [
        (RecordingQuery(), 1), (RecordingQuery(match=2), 2), (RecordingQuery(best=True), 1),
        (RecordingQuery(upset=True), 2), (RecordingQuery(between=("blue@0", "red@4")), 2),
        (RecordingQuery(between=("red@4", "blue@4")), 1), (RecordingQuery(player="blue"), 1),
        (RecordingQuery(best=True, between=("red@0", "red@4")), 3), (RecordingQuery(closest=True), 5),
    ],
)  # fmt: skip
def test_the_match_that_is_meant(store, wish, number):
    with Open(Store.open(store)) as opened:
        assert chosen(opened, wish).id == number


def test_players_have_their_colours_roles_and_the_ratings_before_the_match(store):
    with Open(Store.open(store)) as opened:
        matches = opened.store.matches("cup")
        blue, red = players_of(opened, matches[0], ("blue@4", "red@4"))
        assert (red, blue) == players_of(opened, matches[0], ("red@4", "blue@4"))
        assert blue.role == red.role == "main"
        assert blue.rating == ""  # nothing had been played before
        new, old = players_of(opened, matches[2], ("red@4", "red@0"))
        assert new.colour == red.colour
        assert old.colour != new.colour  # its own past, paler
        assert sum(old.colour) > sum(new.colour)
        later = replace(matches[2], created=matches[2].created + 1e6)
        assert players_of(opened, later, ("red@4",))[0].rating != players_of(opened, later, ("blue@0",))[0].rating != ""
        assert players_of(opened, matches[2], ("pusher",))[0].role == "fixed"
        assert players_of(opened, matches[2], ("gone@1", "red@4"))[0].label == "gone@1"


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("99",), "There is no match 99 in league cup; recorded near it: 1, 2, 3, 5."),
        (("4",), "Match 4 was not recorded; recorded near it: 1, 2, 3, 5."),
        (("--between", "blue@4", "blue@0"), "No match of blue@4 and blue@0 was recorded"),
        (("--between", "blue@4", "blue@4"), "No match of blue@4 and blue@4 was recorded"),
        (("--between", "blue@4"), "--between takes two snapshots"),
        (("--between", "blue@4", "bleu@0"), "Did you mean 'blue@0'"),
        (("--player", "bleu"), "Did you mean 'blue'"),
        (("3", "--best"), "MATCH and --best ask for different matches"),
        (("--live", "--best"), "--live shows every match as it comes"),
        (("1", "--episode", "2"), "Match 1 has 2 recorded, from 0 on; there is no episode 2."),
    ],
)
def test_what_there_is_not_is_told_in_one_line(store, args, says, capsys, tmp_path):
    assert says in refused(capsys, "watch", *args, "--store", str(store), "--save", str(tmp_path / "no.rrd"))
    assert not list(tmp_path.iterdir())


def test_following_gives_the_newest_and_then_each_that_is_filed(tmp_path):
    with filled(tmp_path / "league-data") as store:
        kept = store.blobs.put(to_bytes(cars()))
        finish(store, matches=[match("blue@1", "red@1", 1, 0, recording=kept) for _ in range(2)])
        matches = following(Open(store), poll=0)
        assert next(matches).id == 2
        finish(store, matches=[match("blue@4", "red@4", 1, 0), match("blue@4", "red@4", 1, 0, recording=kept)])
        finish(store, matches=[match("blue@4", "red@0", 1, 0, recording=kept)])
        assert [next(matches).id, next(matches).id] == [4, 5]


def test_pictures_and_films_need_no_graphics_driver(store, tmp_path, capsys, monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nonexistent")
    shot, video = tmp_path / "match.png", tmp_path / "match.gif"
    made = ("--shot", str(shot), "--video", str(video), "--at", "1.5", "--seconds", "0.2", "--rate", "5")
    code, out, err = ran(capsys, "watch", "1", "--store", str(store), *made)
    assert code == 0
    assert "apt-get install mesa-vulkan-drivers; without one it is drawn without curves" in err
    assert f"Wrote {shot}" in out
    with Image.open(shot) as picture, Image.open(video) as film:
        assert (picture.size, film.size) == ((1600, 1000), (960, 600))


@pytest.mark.parametrize("flag", ["--save", "--shot", "--video"])
def test_a_place_that_cannot_be_written_is_told_in_a_line_and_nothing_is_there(store, tmp_path, capsys, flag):
    ending = {"--save": ".rrd", "--shot": ".png", "--video": ".gif"}[flag]
    folder, file = tmp_path / f"folder{ending}", tmp_path / f"file{ending}"
    folder.mkdir()
    file.write_bytes(b"whatever was there")
    places = {
        tmp_path / "none" / f"m{ending}": "No such file or directory", file / f"m{ending}": "Not a directory",
        folder: "is a folder: give the name of a file in it", tmp_path / "m.odd": f"*{ending}",
    }  # fmt: skip
    for place, says in places.items():
        assert says in refused(capsys, "watch", "1", "--store", str(store), flag, str(place))
    assert sorted(path.name for path in tmp_path.rglob("*")) == [file.name, folder.name]
    assert ran(capsys, "watch", "1", "--store", str(store), flag, str(file), "--seconds", "0.1")[0] == 0
    assert file.stat().st_size > 1000  # what was drawn before is drawn anew


def test_a_picture_is_of_the_kind_that_its_name_says(store, tmp_path, capsys):
    shot = tmp_path / "match.jpg"
    assert ran(capsys, "watch", "1", "--store", str(store), "--shot", str(shot))[0] == 0
    with Image.open(shot) as picture:
        assert (picture.format, picture.size) == ("JPEG", (1600, 1000))


def test_a_match_for_foxglove_is_named_by_its_number_and_never_overwrites(store, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = ("export-match", "1", "--foxglove", "--store", str(store))
    assert "Wrote match-1.mcap" in ran(capsys, *asked)[1]
    assert "match-1.mcap exists already" in refused(capsys, *asked)
    assert "give --foxglove" in refused(capsys, *asked[:2], "--store", str(store))


def test_without_a_display_the_commands_that_work_are_named(store, capsys, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for command in (("watch", "--live"), ("browse",)):
        told = refused(capsys, *command, "--store", str(store))
        assert "no display here; use --" in told
        assert "--web" in told
    code, out, err = ran(capsys, "watch", "--store", str(store))
    assert code == 2
    assert "Match 1" in out
    assert "--web for a browser on this machine, --save match.rrd for a file or --shot match.png" in err


def test_a_window_that_cannot_open_is_told_in_a_line(store, capsys, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":4242")  # no X server answers there
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    told = refused(capsys, "browse", "--last", "1", "--store", str(store))
    assert told.endswith(
        "rerun's window did not open here; it needs a display and a graphics driver; "
        "use --web for a browser on this machine, or league watch --save match.rrd for a file\n"
    )


def test_an_episode_with_sides_swapped_and_what_is_whole_of_a_damaged_one(store, capsys, tmp_path):
    saved = ("--store", str(store), "--save", str(tmp_path / "match.rrd"))
    assert "blue@4 against red@4, red@4 wins as red" in ran(capsys, "watch", "1", "--episode", "1", *saved)[1]
    with Store.open(store) as opened:
        digest = str(opened.matches("cup")[4].recording)
    blob = store / "blobs" / digest[:2] / digest[2:]
    whole = blob.read_bytes()
    try:
        blob.write_bytes(whole[: -len(whole) // 20])  # the summary is lost, no step
        assert "--recover shows what is whole" in refused(capsys, "watch", "5", *saved)
        code, out, err = ran(capsys, "watch", "5", "--recover", *saved)
        assert (code, err) == (0, "")
        assert "red@0 against blue@0" in out
        blob.write_bytes(whole[: len(whole) // 3])
        assert "nothing of it is left" in refused(capsys, "watch", "5", "--recover", *saved)
    finally:
        blob.write_bytes(whole)
