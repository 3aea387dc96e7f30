"""`league stop`: ask a running league to stop, and wait until its last process is gone."""

import time

from league.commands.options import Where, parse
from league.state.liveness import leader, processes
from storage.errors import StorageError

WAIT = 90.0  # seconds for workers to finish their iteration; a manager ends those that take longer than a minute


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
        deadline = time.monotonic() + WAIT
        while (left := running()) and time.monotonic() < deadline:
            time.sleep(0.3)
    if left:
        raise StorageError(f"{len(left)} processes of league {league} still work after {WAIT:.0f} s: {left[0]}")
    print(f"League {league} has stopped.")
    return 0
