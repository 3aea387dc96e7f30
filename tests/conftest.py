import os
import secrets
import shutil
from collections.abc import Iterator
from typing import NoReturn

import pytest
import sqlalchemy as sa

os.environ.setdefault("NPROC", "4")  # XLA's threads: with two of them MJX in JAX can hang, see arenas/engines.py

from dashboards.errors import ViewerError
from dashboards.headless import NO_DRIVER, headless_viewer

SERVER = os.environ.get("LEAGUE_TEST_DB")  # e.g. postgresql://user@host/database: runs every test there as well


@pytest.fixture(scope="session")
def graphics():
    """For tests of pictures: skips them where there is no graphics driver, or fails them under REQUIRE_GRAPHICS=1.

    A viewer is started to find out, because a driver that is installed need not work.
    """
    try:
        with headless_viewer((64, 64)):
            return
    except ViewerError as error:
        if str(error) != NO_DRIVER:
            raise
    _without("REQUIRE_GRAPHICS", NO_DRIVER)


@pytest.fixture(scope="session")
def browser():
    """Headless Chromium: where there is none its tests are skipped, or fail under REQUIRE_BROWSER=1."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        _without("REQUIRE_BROWSER", "there is no Chromium: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Chromium's sandbox does not start as root, as which containers run; these pages are our own.
        running = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield running
        running.close()


def server_place() -> Iterator[str]:
    """A URL of the test server under which everything goes into a new schema, dropped at the end."""
    if SERVER is None:
        pytest.skip("no PostgreSQL server: LEAGUE_TEST_DB is not set")
    schema = f"league_test_{secrets.token_hex(6)}"
    url = sa.make_url(SERVER).set(drivername="postgresql+psycopg")
    server = sa.create_engine(url)
    with server.begin() as db:
        db.execute(sa.schema.CreateSchema(schema))
    yield url.update_query_dict({"options": f"-csearch_path={schema}"}).render_as_string(hide_password=False)
    with server.begin() as db:
        db.execute(sa.schema.DropSchema(schema, cascade=True))
    server.dispose()


@pytest.fixture
def server_url() -> Iterator[str]:
    """A place for a store on PostgreSQL; the test is skipped where there is none."""
    yield from server_place()


def _without(switch: str, why: str) -> NoReturn:
    """Skip a test for want of something, or fail it where the switch says that all is there."""
    if os.environ.get(switch, "0") not in ("", "0"):
        pytest.fail(f"{why} ({switch}=0 skips this test)", pytrace=False)
    pytest.skip(why)
