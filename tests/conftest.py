import os
import shutil
from typing import NoReturn

import pytest

os.environ.setdefault("NPROC", "4")  # XLA's threads: with two of them MJX in JAX can hang, see arenas/engines.py

from dashboards.errors import ViewerError
from dashboards.headless import NO_DRIVER, headless_viewer


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


def _without(switch: str, why: str) -> NoReturn:
    """Skip a test for want of something, or fail it where the switch says that all is there."""
    if os.environ.get(switch, "0") not in ("", "0"):
        pytest.fail(f"{why} ({switch}=0 skips this test)", pytrace=False)
    pytest.skip(why)
