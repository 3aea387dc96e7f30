"""`league migrate`: bring the store of an earlier version up to date."""

from dataclasses import dataclass

from league.commands.options import STORE, parse
from storage.database.schema import newest_schema
from storage.store import Store


@dataclass(frozen=True)
class MigrateOptions:
    """The store to bring up to date."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""


def migrate(args: list[str]) -> int:
    """Bring a store up to date, and report it."""
    what = (
        "Bring the store of an earlier version up to date. A SQLite store is copied before, and any command does it;"
        " a server's is changed as it stands, so keep a copy of your own."
    )
    options = parse(MigrateOptions, args, "migrate", what)
    with Store.open(options.store, blobs=options.blobs, migrate=True) as store:
        print(f"{store.where} is up to date: schema {newest_schema()}.")
    return 0
