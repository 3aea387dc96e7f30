"""`league init`: write a commented league.toml."""

from dataclasses import dataclass
from pathlib import Path

from league.commands.options import parse, positional
from league.config import experiment as configuration
from league.config import presets
from league.config.schema import ConfigError


@dataclass(frozen=True)
class InitOptions:
    """The folder to write to, and the settings to write."""

    folder: str = positional(".")
    """Folder for league.toml (default: this one)."""
    preset: str = "quickstart"
    """Settings to start from: quickstart, duel, alphastar, psro, sumo-by-team, ...; `league presets` lists all."""


def init(args: list[str]) -> int:
    """Write a commented league.toml; never overwrite a file."""
    options = parse(InitOptions, args, "init", "Write a commented league.toml with every setting.")
    text = configuration.dumps(presets.preset(options.preset))
    if not options.folder:
        raise ConfigError((), "league init needs a folder: give its name, or . for this one")
    folder = Path(options.folder)
    path = folder / "league.toml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise ConfigError((), f"{path} exists already: move it away, or give another folder") from None
    except OSError as error:
        raise ConfigError((), f"cannot write {path}: {error.strerror}") from None
    print(f"Wrote {path}. `league run {path}` runs it.")
    return 0
