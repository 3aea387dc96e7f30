"""A SQLite store whose file is moved away, deleted or replaced while processes have it open."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from storage.errors import Unavailable
from storage.records import Job
from storage.store import Store
from tests.storage.conftest import fill, match


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def opened(folder: Path):
    with Store.open(folder, create=True) as store:
        fill(store)
        store.queue([Job("cup", "any", "a job")])
        yield store


@pytest.mark.parametrize("what", ["the file", "its folder"])
def test_a_file_that_is_gone_is_waited_for_and_not_made_anew(opened: Store, folder: Path, tmp_path: Path, what: str):
    claimed = opened.claim("cup", ["any"], "tester", 60)
    assert claimed
    moved = folder if what == "its folder" else folder / "league.db"
    moved.rename(tmp_path / "unmounted")
    verbs: list[Callable[[], object]] = [
        opened.now,
        lambda: opened.matches("cup"),
        lambda: opened.queue([Job("cup", "any", "another")]),
        lambda: opened.renew(claimed[0], 60),
        lambda: opened.finish(claimed[0], matches=[match(1)]),
    ]
    for verb in verbs:
        with pytest.raises(Unavailable, match=r"not there .*wait and try again") as caught:
            verb()
        assert "\n" not in str(caught.value)
        assert not (folder / "league.db").exists()
    (tmp_path / "unmounted").rename(moved)
    opened.finish(claimed[0], matches=[match(1)])
    assert [each.seed for each in opened.matches("cup")] == [1]


def test_a_file_that_is_replaced_is_the_store_from_then_on(opened: Store, folder: Path, tmp_path: Path):
    opened.close()  # so that all is in the file, as in a backup
    shutil.copy(folder / "league.db", tmp_path / "backup.db")
    opened.queue([Job("cup", "any", "after the backup")])
    assert len(opened.jobs("cup")) == 2
    opened.close()
    assert len(opened.jobs("cup")) == 2
    for path in folder.glob("league.db*"):
        path.unlink()
    shutil.copy(tmp_path / "backup.db", folder / "league.db")
    opened.queue([Job("cup", "any", "afterwards")])
    with Store.open(folder) as other:
        assert {each.key for each in other.jobs("cup")} == {"a job", "afterwards"}


def test_what_was_written_to_a_file_that_went_meanwhile_is_not_taken_for_written(
    opened: Store, folder: Path, tmp_path: Path
):
    with pytest.raises(Unavailable), opened._db.writing():
        (folder / "league.db").rename(tmp_path / "unmounted")
