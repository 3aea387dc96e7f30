"""The tasks of the bench as values. They load neither jax nor torch.

A task never changes. Its configuration hash is that of the arena which the code builds: rules, timing, compiled bodies
and MuJoCo's version. Where the code computes another hash, the task is refused, because its results could not be
compared; a changed task gets another version, and the former one stays in this list.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from zlib import crc32

from league.config.experiment import Config, change, default
from league.config.flags import Given
from league.config.schema import ConfigError
from storage.errors import UnknownName

if TYPE_CHECKING:
    from arenas.arena import Arena

GAMES = 2048
"""Games of each pair in a record; with fewer the result is a trial."""
BATCH = 256
"""Maximum number of games played at once, from one seed."""
MUJOCO = "3.17.0"
TRACKS: Mapping[str, str] = {
    "50M": "50 million decisions of a side",
    "200M": "200 million decisions of a side",
    "10min": "10 minutes of one GPU",
    "1h": "an hour of one GPU",
    "30min-cpu": "30 minutes of two cores",
}
"""Training that an entry had at most, its population included, by the name of the track; only its own word says so."""
OF_ROBOTS = ("50M", "200M", "10min", "1h")


@dataclass(frozen=True)
class Task:
    """A game with all that its results depend on."""

    name: str
    arena: str
    config_hash: str
    sides: Mapping[str, str]  # team -> roster, as the arena has them
    about: str
    settings: Given = field(default_factory=dict)  # differences from the arena's defaults, as flags of `league run`
    exact: bool = False  # entries have an exact exploitability, and play no matches
    package: str = "0.3.0"  # version of the package with which the task was frozen
    lacks: str = ""  # references that still have to be trained
    tracks: tuple[str, ...] = OF_ROBOTS  # names of TRACKS

    @property
    def alike(self) -> bool:
        """Return whether all sides have one roster, so that an entry plays each of them."""
        return len(set(self.sides.values())) == 1

    @property
    def teams(self) -> tuple[str, ...]:
        """Return the sides for each of which an entry has a policy: the first stands for all if they are alike."""
        return tuple(self.sides)[: 1 if self.alike else None]

    @property
    def seed(self) -> int:
        """Return the seed of records, from which the seeds of all games are derived."""
        return crc32(self.name.encode())

    @property
    def arena_command(self) -> str:
        """Return the command that describes the task's arena, with the settings in which it differs from its own."""
        flags = "".join(f" --{'.'.join(key)} {value}" for key, value in self.settings.items())
        return f"league arenas {self.arena}{flags}"

    def config(self) -> Config:
        """Return the settings of a league in the task's arena, on the C engine."""
        return change(default(self.arena), {("engine",): "c", **self.settings})

    def build(self, worlds: int = 1) -> "Arena":
        """Build the arena on the C engine. Raises ConfigError, one line, if its hash is not the frozen one."""
        arena = self.config().arena.build(engine="c", worlds=worlds)
        if arena.config_hash != self.config_hash:
            import mujoco

            raise ConfigError(
                (), f"{self.name} is frozen at configuration {self.config_hash}, and this code computes"
                f" {arena.config_hash} (MuJoCo {mujoco.__version__}), whose results could not be compared: install"
                f" robot-league {self.package} with mujoco {MUJOCO}, or take a later version of the task",
            )  # fmt: skip
        return arena


FREE = {("arena", "rules", "drive_scale"): "40.0", ("arena", "rules", "steer_scale"): "0.5"}
"""Scales of a Leatherback's action, those of the presets `soccer-1v1` and `soccer-2v2`. `leatherback-score` and
`leatherback-soccer` learnt with the arena's own, 10 and 0.1 (docs/bench.md)."""
NARROW = {
    ("arena", "rules", "hit"): "ray", ("arena", "rules", "ray"): "0.5", ("arena", "rich"): "true",
    ("arena", "buffer"): "8",
}  # fmt: skip
ROVERS = "leatherback:38:2+leatherback:38:2"
GPU = "early, middle and late learners and exploiters wait for GPU time"
SEEDS = "learners of other seeds and exploiters wait for GPU time"


def _cards(game: str, config_hash: str, roster: str, about: str) -> Task:
    return Task(f"t0-{game}-v1", game, config_hash, {"blue": roster, "red": roster}, about, exact=True, tracks=())


TASKS: Mapping[str, Task] = {
    task.name: task
    for task in (
        _cards("kuhn-poker", "2254b6c1d7eecf29", "kuhn:10:2", "Kuhn poker; exact exploitability"),
        _cards("leduc-poker", "0446d8263eea9bee", "leduc:31:3", "Leduc poker; exact exploitability"),
        _cards("dark-hex-3", "f21c81b528f09517", "hex:20:9", "dark hex on 3 by 3 cells; exact exploitability"),
        Task(
            "t1-sumo-rovers-v1", "sumo-2v2", "6345d6398370febf", {"blue": ROVERS, "red": ROVERS},
            "two rovers push two rovers out of a ring that shrinks; for a laptop", tracks=tuple(TRACKS),
        ),
        Task(
            "t2-sumo-unlike-v1", "sumo-by-team", "53ad9c7220344f80",
            {"blue": "anymal:56:12+anymal:56:12", "red": "leatherback:14:2+leatherback:14:2"},
            "two ANYmals against two Leatherbacks in a ring", lacks=SEEDS,
        ),
        Task(
            "t3-soccer-1v1-v1", "soccer-1v1", "b2aedb1edf484053", {"blue": "anymal:66:12", "red": "leatherback:24:2"},
            "an ANYmal against a Leatherback; the first goal wins", FREE, lacks=SEEDS,
        ),
        Task(
            "t3-soccer-2v2-v1", "soccer-2v2", "ecc6c177c960d6c5",
            {"blue": "anymal:66:12+anymal:66:12", "red": "leatherback:24:2+leatherback:24:2"},
            "two ANYmals against two Leatherbacks; the first goal wins", FREE, lacks=GPU,
        ),
        Task(
            "t4-galaga-1v1-v1", "galaga-1v1", "4247d12898b7ba3d", {"blue": "minitank:18:2", "red": "crazyflie:20:4"},
            "a tank with a ray of 0.5 m against a drone that sees it", NARROW, lacks=SEEDS,
        ),
        Task(
            "t5-pursuit-v1", "pursuit", "3ddc05d8d682d85c",
            {"predators": "predator:17:2+predator:17:2+predator:17:2", "prey": "prey:15:2"},
            "three predators catch a faster prey",
            lacks="an exploiter of the late predators waits for GPU time",
        ),
        Task(
            "t6-sumo-ants-v1", "sumo-ants", "bbf54a311b8608a1", {"blue": "ant:64:8", "red": "ant:64:8"},
            "an ant pushes an ant over or out of a ring (Bansal et al. 2018)", lacks=SEEDS,
        ),
    )
}  # fmt: skip


def find(name: str) -> Task:
    """Return a task by name. Raises UnknownName, one line with all tasks."""
    if name not in TASKS:
        raise UnknownName("task", name, list(TASKS))
    return TASKS[name]
