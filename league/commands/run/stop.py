"""`league stop`: ask a running league to stop, and wait until its last process is gone."""

import time

from league.commands.options import Where, parse
from league.state.liveness import grace, leader, processes
from storage.errors import StorageError

WAIT = 30.0  # seconds beyond those in which a manager lets workers finish their iteration


def stop(args: list[str]) -> int:
    """Stop a running league."""
    options = parse(Where, args, "stop", "Stop a running league; what its workers do is finished and kept.")
    with options.open() as opened:
        store, league = opened.store, opened.league

        def running() -> list[str]:
            found = leader(store, league)
            return [*([found] if found else []), *(worker.id for worker in processes(store, league))]

        if not running():
            print(f"League {league} is not running.")
            return 0
        store.ask_stop(league)
        print(f"Stopping league {league}: its workers finish what they are at.", flush=True)
        wait = grace(processes(store, league)) + WAIT
        deadline = time.monotonic() + wait
        while (left := running()) and time.monotonic() < deadline:
            time.sleep(0.3)
    if left:
        raise StorageError(f"{len(left)} processes of league {league} still work after {wait:.0f} s: {left[0]}")
    print(f"League {league} has stopped.")
    return 0
