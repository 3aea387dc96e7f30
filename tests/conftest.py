import gc
import os
import secrets
import shutil
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest
import sqlalchemy as sa

os.environ.setdefault(
    "NPROC", "4"
)  # XLA's threads: with two of them MJX in JAX can hang, see arenas/physics/registry.py

# Torch has one thread in each process, as in a worker of a league on two cores. Several pytest processes share the
# cores, and threads that wait for each other took 38 % of the processor time of tests/league/training/test_trainer.py.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# JAX keeps compiled programs for later tests, for the other processes of pytest-xdist, and for the slow suite. It
# writes its files without a lock: what is read half written is compiled instead, with a warning (see pyproject.toml).
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "compiled"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")

from dashboards.errors import ViewerError
from dashboards.viewer.headless import NO_DRIVER, headless_viewer
from tests.faults import servers

gc.disable()  # until all tests are collected: imports make many objects and hardly any garbage

SERVER = os.environ.get("LEAGUE_TEST_DB")  # e.g. postgresql://user@host/database: runs every test there as well


def _seed(text: str) -> None:
    """Seed torch's global generator, so that no result depends on the tests that ran before in this process."""
    if "torch" in sys.modules:
        import torch

        torch.manual_seed(zlib.crc32(text.encode()))


def pytest_fixture_setup(fixturedef: pytest.FixtureDef, request: pytest.FixtureRequest) -> None:
    """Seed before each fixture is built: one of a session may be built in any test."""
    _seed(str(fixturedef.argname))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Seed before each test."""
    _seed(item.nodeid)


@pytest.fixture(autouse=True)
def _optimised(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let XLA optimise fully what tests marked `optimised` compile, where it optimises little otherwise.

    JAX asks for this when it compiles, and a program that it has compiled stays as it is until JAX forgets it.
    """
    if request.node.get_closest_marker("optimised") is None:
        yield
        return
    import jax

    setting = "jax_disable_most_optimizations"
    little = jax.config.read(setting)
    jax.config.update(setting, False)
    jax.clear_caches()
    yield
    jax.config.update(setting, little)
    jax.clear_caches()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse tests that are marked elsewhere than in their file: `make test-slow` finds files by these words."""
    for mark in ("slow", "optimised"):
        files = {item.path for item in items if item.get_closest_marker(mark)}
        for file in files:
            if f"mark.{mark}" not in file.read_text("utf-8"):
                raise pytest.UsageError(f"{file} has tests marked {mark}, and no mark.{mark}")


def pytest_collection_finish() -> None:
    """Leave what has been imported out of garbage collections, and collect less often than at every 700 objects.

    A collection would look through all imported modules for half a second. Tracing programs makes thousands of objects.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()
    if "warp" in sys.modules and os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS"):
        import warp

        warp.config.optimization_level = 0  # as XLA: a third less processor time for a test of Warp on a CPU


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep a folder's tests in one process under `--dist loadfile`.

    They use the same arenas, and each process compiles those by itself.
    """
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class LoadFolderScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return nodeid.partition("::")[0].rpartition("/")[0]

    return LoadFolderScheduling(config, log)


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
        # Chromium brings a driver of its own, in software, which this variable would hide too.
        kept: dict[str, str | float | bool] = {k: v for k, v in os.environ.items() if k != "VK_DRIVER_FILES"}
        running = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"], env=kept)
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


@pytest.fixture(scope="session")
def pgbouncer() -> None:
    """PgBouncer and PostgreSQL: without them its tests are skipped, or fail under REQUIRE_POOLER=1."""
    if servers.programs() is None or servers.pooler() is None:
        _without("REQUIRE_POOLER", "there is no PgBouncer: apt-get install pgbouncer")


def _without(switch: str, why: str) -> NoReturn:
    """Skip a test for want of something, or fail it where the switch says that all is there."""
    if os.environ.get(switch, "0") not in ("", "0"):
        pytest.fail(f"{why} ({switch}=0 skips this test)", pytrace=False)
    pytest.skip(why)
