"""A command that Ctrl-C stopped leaves no interpreter that XLA's threads could crash while it is torn down."""

import subprocess
import sys

from tests.league.conftest import ENVIRONMENT

SCRIPT = """
import atexit, sys
import jax
from league.__main__ import main
from league.commands import cli
atexit.register(print, "torn down", flush=True)
cli.main = lambda: sys.exit({code})
main()
"""


def ended(code: int) -> tuple[int, str]:
    command = [sys.executable, "-c", SCRIPT.format(code=code)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=ENVIRONMENT)
    return done.returncode, done.stdout.strip()


def test_ctrl_c_ends_a_process_with_jax_at_once():
    assert ended(130) == (130, "")


def test_other_ends_are_orderly():
    assert ended(2) == (2, "torn down")
