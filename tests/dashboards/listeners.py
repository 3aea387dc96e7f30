"""On which addresses the processes of a test listen, by what Linux says of their sockets."""

import os
from pathlib import Path

LISTENS = "0A"
LOOPBACK = {"0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F"}
"""127.0.0.1, ::1 and ::ffff:127.0.0.1, as in /proc/net/tcp on a machine of little endian."""


def descendants(pid: int) -> set[int]:
    """A process and all that it has started, directly or not."""
    parent = {}
    for each in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent[int(each.parent.name)] = int(each.read_text().rpartition(")")[2].split()[1])
        except OSError:  # it has ended meanwhile
            continue
    found, more = {pid}, {pid}
    while more:
        more = {child for child, of in parent.items() if of in more} - found
        found |= more
    return found


def listeners(pid: int) -> dict[int, str]:
    """The ports on which a process and its descendants listen, with their addresses in hexadecimal digits."""
    inodes = set()
    for each in descendants(pid):
        for link in Path(f"/proc/{each}/fd").glob("*"):
            try:
                target = os.readlink(link)
            except OSError:
                continue
            if target.startswith("socket:["):
                inodes.add(target[len("socket:[") : -1])
    found = {}
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if state == LISTENS and inode in inodes:
                address, _, port = local.partition(":")
                found[int(port, 16)] = address
    return found
