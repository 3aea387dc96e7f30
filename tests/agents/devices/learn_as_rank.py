"""python -m tests.agents.devices.learn_as_rank FOLDER: a rank that torchrun starts, and that learns a case there."""

import os
import sys
from pathlib import Path

import torch

from agents.devices import distributed, rendezvous


def main(folder: Path) -> None:
    """Learn this rank's part of the case, and write what was learnt."""
    torch.set_num_threads(1)
    meeting = rendezvous.meet(rendezvous.place_of(os.environ), 120)
    place = meeting.place
    rendezvous.use_route_to(place.address)
    comm = distributed.connect(meeting.store, place.rank, place.size, on_gpus=False)
    case = torch.load(folder / "case", weights_only=False)
    torch.save(case.part(place.rank).learn(comm), folder / f"rank{place.rank}")
    comm.gather(0)  # all have written
    os._exit(0)  # as a league's ranks end: at a usual exit threads of gloo may abort the process


if __name__ == "__main__":
    main(Path(sys.argv[1]))
