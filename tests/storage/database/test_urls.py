"""What is a folder and what is a URL; where blobs go; that no password is ever told."""

from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.database.urls import BLOBS_VARIABLE, database_url, display_url, several_hosts
from storage.errors import StorageError
from storage.store import Store


@pytest.mark.parametrize(
    ("where", "complaint"),
    [
        ("mysql://host/db", r"mysql://host/db.*postgresql://user@host/database is possible"),
        ("sqlite://", "give a file"),
        ("sqlite:///:memory:", "give a file"),
        ("sqlite://runs/league.db", "give a file"),
        ("not a url://", "looks like a URL"),
        ("sqlite:league.db", "looks like a URL but is no database's: a folder, sqlite:///"),
        ("sqlite:/runs/league.db", "looks like a URL"),
        ("postgresql:/host/db", "looks like a URL"),
        ("postgresql//host/db", "looks like a URL"),
        ("postgres://host/db", "is possible"),
        (" postgresql://host/db", "is possible"),
        ("http:league", r"looks like a URL.*a folder with such a name as ./name"),
        ("postgresql://host:port/db", "looks like a URL"),
        ("postgresql://host/db", f"say where its blobs are kept.*--blobs PLACE, or {BLOBS_VARIABLE}"),
    ],
)
def test_what_looks_like_a_url_is_one_or_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, complaint: str
):
    monkeypatch.chdir(tmp_path)
    for create in (False, True):
        with pytest.raises(StorageError, match=complaint) as caught:
            Store.open(where, create=create)
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["runs", "./a:b", "postgres/data", "runs//x", "1:30", "a b"])
def test_other_names_are_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    monkeypatch.chdir(tmp_path)
    Store.open(name, create=True).close()
    assert (tmp_path / name / "league.db").is_file()


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://me:hush@127.0.0.1:1/db",
        "postgresql+psycopg://me:hush@127.0.0.1:1/db",
        "postgresql://me@127.0.0.1:1/db?password=hush",
        "postgresql://127.0.0.1:1/db?pass%77ord=hush&sslpassword=hush",
        "postgresql://me:a@127.0.0.1:1/db?password=hush&password=hush",
        "postgresql://me:hush@127.0.0.1:port/db",
        "postgresql://me:hush@127.0.0.1:1,127.0.0.1:2/db",
        "postgresql://me:hush@127.0.0.1:1,127.0.0.1:port/db",
        "postgresql://me:hush@hush@127.0.0.1:1/db",
        "postgresql://me:hush/hush@127.0.0.1:1/db",
        "postgresql://127.0.0.1:port/db?password=hush",
        "postgresql:/me:hush@127.0.0.1/db",
        "postgresql:me:hush@127.0.0.1/db",
        "postgres://me:hush@127.0.0.1/db",
        "mysql://me:hush@127.0.0.1/db?password=hush",
        "postgresql//me:hush@127.0.0.1/db",
        "sqlite://me:hush@127.0.0.1/db",
        "postgresql://me:hush",
        "postgresql://me:hush/db",
        "postgresql://me:x?hush@127.0.0.1:port/db",
        "postgresql://127.0.0.1:port/db?password=x@hush",
    ],
)
def test_a_password_is_never_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str):
    monkeypatch.chdir(tmp_path)
    for blobs in (None, str(tmp_path)):
        with pytest.raises(StorageError) as caught:
            Store.open(url, create=True, blobs=blobs)
        error: BaseException | None = caught.value
        while error is not None:  # nor by `--debug`, which tells what led to it
            assert "hush" not in f"{error} {error!r}"
            error = error.__cause__
    assert list(tmp_path.iterdir()) == []


def test_a_password_reaches_the_server_and_nothing_else(server_url: str, tmp_path: Path):
    given = sa.make_url(server_url)
    word = str(given.password or "hush")  # a server that trusts everybody takes any
    url = given.set(password=None).update_query_dict({"password": word, "application_name": "not-a-secret"})
    with Store.open(url.render_as_string(hide_password=False), create=True, blobs=str(tmp_path)) as store:
        assert word not in store.where
        assert "application_name=not-a-secret" in store.where
        assert store.leagues() == []
    assert database_url("postgresql://me@host/db?password=hush").password == "hush"
    assert display_url(database_url("postgresql://me@host/db?password=hush")) == "postgresql://me:***@host/db"


@pytest.mark.parametrize(
    ("where", "hosts"),
    [
        ("postgresql://me:hush@a:1,b:2/db?target_session_attrs=read-write", ("a:1", "b:2")),
        ("postgresql://a,b.example/db", ("a", "b.example")),
        ("postgresql+psycopg://me@a:5432,b,c", ("a:5432", "b", "c")),
        ("postgresql://me:p%2Cw@a/db", ()),
    ],
)
def test_a_url_of_several_hosts_is_shown_as_it_was_written(where: str, hosts: tuple[str, ...]):
    url = database_url(where)
    assert several_hosts(url) == hosts
    shown = where.replace("+psycopg", "").replace("hush", "***").replace("p%2Cw", "***").replace(",c", ",c/")
    assert display_url(url) == shown
    assert display_url(database_url(shown)) == shown


def test_blobs_are_where_was_said_else_where_the_environment_says_else_beside_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def folder(**options: str) -> str:
        with Store.open(tmp_path / "store", create=True, **options) as store:  # type: ignore[arg-type]
            digest = store.blobs.put(b"a policy")
        (found,) = tmp_path.rglob(digest[2:])
        found.unlink()
        return str(found.relative_to(tmp_path).parts[:-2])

    assert folder() == "('store', 'blobs')"
    monkeypatch.setenv(BLOBS_VARIABLE, str(tmp_path / "said"))
    assert folder() == "('said',)"
    assert folder(blobs=(tmp_path / "given").as_uri()) == "('given',)"


def test_a_server_takes_its_blobs_from_the_environment(
    server_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    with pytest.raises(StorageError, match=f"--blobs PLACE, or {BLOBS_VARIABLE}"):
        Store.open(server_url, create=True)
    monkeypatch.setenv(BLOBS_VARIABLE, str(tmp_path))
    with Store.open(server_url, create=True) as store:
        assert store.blobs.get(store.blobs.put(b"a policy")) == b"a policy"
