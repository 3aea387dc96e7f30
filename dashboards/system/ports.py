"""Ports of this machine on which pages are served."""

import http.client
import socket

from dashboards.errors import ViewerError

HOST = "127.0.0.1"
NAME = "robot-league"  # in the header `Server`
MAX_PORT = 65_535
PORTS_TRIED = 100  # ports after a taken one that are tried


def listen(port: int) -> socket.socket:
    """Return a socket that listens on a port of this machine and that no other machine can reach.

    Raises ViewerError where the port is taken, with the kind of server that has it and the next free port.
    """
    try:
        return _listen(port)
    except PermissionError as error:
        raise ViewerError(f"this user may not listen on port {port}: give one above 1023, as in --port 8710") from error
    except OSError as error:
        free = next((near for near in range(port + 1, min(port + PORTS_TRIED, MAX_PORT + 1)) if _is_free(near)), None)
        advice = f"port {free} is free: --port {free}" if free else "give another with --port"
        raise ViewerError(f"port {port} is taken{_holder(port)}; {advice}") from error


def next_port(port: int) -> int:
    """Return the port after `port`, so that one that forwards ports to this machine knows both; any other if it is
    taken.
    """
    if port < MAX_PORT and _is_free(port + 1):
        return port + 1
    with socket.create_server((HOST, 0)) as free:
        return free.getsockname()[1]


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # at once after one that has just ended
        listener.bind((HOST, port))
        listener.listen()  # only now is it known that nobody else does
    except OSError:
        listener.close()
        raise
    return listener


def _is_free(port: int) -> bool:
    try:
        _listen(port).close()
    except OSError:
        return False
    return True


def _holder(port: int) -> str:
    """Return the kind of server that has a port, if it answers."""
    connection = http.client.HTTPConnection(HOST, port, timeout=1)
    try:
        connection.request("GET", "/page.js")
        ours = connection.getresponse().headers.get("Server") == NAME
    except (OSError, http.client.HTTPException):
        return ""
    finally:
        connection.close()
    return " by another league dash" if ours else " by another web server"
