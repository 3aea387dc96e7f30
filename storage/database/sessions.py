"""Sessions of a PostgreSQL server, reached directly or through a pooler such as PgBouncer.

A pooler in transaction mode gives every transaction any of its server sessions. Settings of a session and prepared
statements do not survive there, so that each transaction carries its own settings and no statement is prepared.
"""

from typing import Any

import sqlalchemy as sa
from sqlalchemy import event

from storage.errors import StorageError

LIMITS = ("lock_timeout", "idle_in_transaction_session_timeout")
_REFUSED = "unsupported startup parameter"  # how PgBouncer refuses `options`


def serve_clients(engine: sa.Engine, where: str, wait: str, given: str, read_only: bool) -> None:
    """Let an engine of PostgreSQL recognise a pooler on each new connection, and adapt to it.

    A transaction waits at most `wait` (with a unit, as PostgreSQL writes it) for a lock or for its own client. `given`
    are options of the user's URL, which a pooler would drop silently. With `read_only`, transactions refuse to write.

    A new connection raises StorageError where a pooler permits no transactions (statement mode) or `given` is not
    empty.
    """
    limits = ", ".join(f"set_config('{name}', '{wait}', true)" for name in LIMITS)
    direct = {"options": f"{' '.join(f'-c {name}={wait}' for name in LIMITS)} {given}".strip()}
    pooled = False  # once known, later connections ask for no options

    @event.listens_for(engine, "do_connect")
    def _connect(dialect: Any, record: Any, args: Any, parameters: dict[str, Any]) -> Any:
        nonlocal pooled
        plain = {name: value for name, value in parameters.items() if name != "options"}
        try:
            connection = dialect.connect(*args, **plain, **({} if pooled else direct))
        except dialect.loaded_dbapi.OperationalError as error:
            if pooled or _REFUSED not in str(error):
                raise
            connection = dialect.connect(*args, **plain)
        try:
            pooled = record.info["pooled"] = _is_pooled(connection, where, dialect.loaded_dbapi.Error)
            if pooled and given:
                raise StorageError(
                    f"{where}: a pooler stands before this server and drops options={given!r} of the URL: set them for"
                    " the user, by ALTER ROLE ... SET."
                )
            if pooled:
                connection.prepare_threshold = None
            elif read_only:
                connection.execute("SET default_transaction_read_only = on")
                connection.commit()
            connection.read_only = read_only or None
        except BaseException:
            connection.close()
            raise
        return connection

    @event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        driver: Any = connection.connection.driver_connection
        if connection.info.get("pooled") and not driver.autocommit:
            connection.exec_driver_sql(f"SELECT {limits}")


def _is_pooled(connection: Any, where: str, driver_error: type[Exception]) -> bool:
    """Return whether a pooler answers: the process id that it gave is not that of the server's process.

    Raises StorageError where it permits no transactions.
    """
    try:
        pid = connection.execute("SELECT pg_backend_pid()").fetchone()[0]
        connection.rollback()
    except driver_error as error:
        if "statement pooling" in str(error):
            raise StorageError(
                f"{where}: the pooler before this server is in statement mode, which permits no transactions; a store"
                " needs pool_mode = transaction or session."
            ) from error
        raise
    return pid != connection.info.backend_pid
