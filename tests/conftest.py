import os

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
    if os.environ.get("REQUIRE_GRAPHICS", "0") not in ("", "0"):
        pytest.fail(f"{NO_DRIVER} (REQUIRE_GRAPHICS=0 skips this test)", pytrace=False)
    pytest.skip(NO_DRIVER)
