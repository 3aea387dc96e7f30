"""A league as each process of its run receives it: the store, and the configuration as text.

The process that starts a league writes its configuration once, with `RunSpec.of`. All other processes get that
text and parse it once. Loads neither torch, jax nor mujoco.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

from league.config import experiment
from league.config.experiment import Config


@dataclass(frozen=True)
class RunSpec:
    """The store and the configuration of a league, in a form that crosses process borders as it is.

    `worlds`, `rating_worlds` and `rating_pairings` are the sizes of this run, chosen by device, for settings that the
    configuration leaves open. They are no part of the text: the store keeps these settings open, for another machine.
    """

    store: str
    blobs: str | None
    config_toml: str
    worlds: int | None = None
    rating_worlds: int | None = None
    rating_pairings: int | None = None

    @classmethod
    def of(cls, store: str, config: Config) -> "RunSpec":
        """Return the spec of a configuration, written as text, and the store of its run."""
        return cls(store, config.storage.blobs, experiment.dumps(config))

    def config(self) -> Config:
        """Return the configuration with the sizes of this run; a process parses the same text only once.

        Raises ConfigError.
        """
        return self.sized(_parsed(self.config_toml))

    def sized(self, config: Config) -> Config:
        """Return a configuration with the sizes of this run."""
        training = config.training if self.worlds is None else replace(config.training, worlds=self.worlds)
        sizes = {"worlds": self.rating_worlds, "pairings": self.rating_pairings}
        rating = replace(config.rating, **{name: size for name, size in sizes.items() if size is not None})
        return replace(config, training=training, rating=rating)


@lru_cache(maxsize=4)
def _parsed(text: str) -> Config:
    return experiment.loads(text)
