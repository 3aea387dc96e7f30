"""A process that may run on one core counts one."""

import os
import subprocess
import sys

import pytest

from arenas.physics.cpu import cores


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no system that pins processes")
def test_cores_are_those_that_the_process_may_run_on():
    first = min(os.sched_getaffinity(0))
    asked = f"import os; os.sched_setaffinity(0, {{{first}}}); from arenas.physics.cpu import cores; print(cores())"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"
    assert cores() == len(os.sched_getaffinity(0))
