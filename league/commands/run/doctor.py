"""`league doctor`: an examination of this machine, and the commands that bring what it lacks."""

import json
from dataclasses import dataclass
from typing import Literal

from dashboards.tables import Column, render
from league.commands.options import parse
from league.commands.progress_bar import Progress
from league.system import exit_codes

COLUMNS = (Column("check", "", no_wrap=True), Column("state", "", no_wrap=True), "found", Column("advice", "to do"))


@dataclass(frozen=True)
class DoctorOptions:
    """The format of the output."""

    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def doctor(args: list[str]) -> int:
    """Examine this machine; return 0 if leagues can run here, otherwise 1."""
    options = parse(DoctorOptions, args, "doctor", "Examine this machine. Changes nothing.")
    from league.system import diagnosis

    found = []
    with Progress("examining") as progress:
        for finding in diagnosis.examine():
            found.append(finding._asdict())
            progress.tell(finding.check, len(found), None)
    print(json.dumps(found, indent=2) if options.format == "json" else render(found, COLUMNS))
    return exit_codes.NO if any(each["state"] == "missing" for each in found) else exit_codes.DONE
