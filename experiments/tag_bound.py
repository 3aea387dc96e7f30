"""Reach of 80 % against two taggers in tag, and the cost of noise in actions.

    python -m experiments.tag_bound [--episodes N] [--out FILE]

Scripts play one of three pucks against two `tagger` on the C engine, in all rotations of seats. The score is the mean
over both of 1 for more seconds as "it", ½ for equal ones and 0 for fewer: `tagger` itself has 50 %, and so has whoever
is first in a third of the games and last in a third.

- `planner` knows the dynamics: a puck's velocity approaches speed × thrust with the time constant τ = speed ∙ mass /
  thrust. As "it" it takes, of 32 directions, the one in which it stays out of the reach of all others longest, where
  the reach of a puck after t seconds is a disc about the point to which its velocity carries it. Otherwise it takes the
  direction in which it touches "it" soonest, if that goes straight on.
- `tagger ± s` adds noise of deviation s to the action of `tagger`, whose length is 1, as a Gaussian policy does;
  `3 × tagger ± s` adds it to three times the action. The arena then limits the length to 1.
"""

from collections.abc import Mapping

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.games.tag import scripts as tag_scripts
from arenas.games.tag.match import Tag
from arenas.games.tag.observation import TagView, read
from arenas.games.tag.settings import IT_SIZE, KIND, OTHER_SIZE, OWN_SIZE, TagRules, TagSettings
from arenas.robots.robot import Script
from scripts import script_tournament
from scripts.record import make_parser, report, run_info

DEVIATIONS = (0.1, 0.3, 0.5)
ANGLES = np.linspace(0.0, 2 * np.pi, 32, endpoint=False)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)  # (32, 2)
MOMENTS = np.linspace(0.1, 1.0, 10)[:, None]  # s from now
STRAIGHT = 0.4  # s for which "it" is expected to go straight on


def planner(rules: TagRules) -> Script:
    """Return the script that knows the dynamics, for pucks of 1 kg."""
    tau, room = rules.speed / rules.thrust, rules.side / 2 - rules.radius
    touch = 2 * rules.radius + rules.reach
    carried = tau * (1 - np.exp(-MOMENTS / tau))  # s, by which the present velocity counts, (moments, 1)
    reach = rules.speed * (MOMENTS - carried)  # m, of full thrust in any direction

    def paths(view: TagView) -> Array:
        """Return its places from now on by direction, (moments, 32, 2), as if there were no walls."""
        return (view.position + carried * view.velocity)[:, None] + reach[..., None] * DIRECTIONS

    def flee(view: TagView, velocities: Array) -> Array:
        middles = view.position + view.gaps[:, None] + carried * velocities[:, None]  # (others, moments, 2)
        ends = jnp.clip(paths(view), -room, room)
        gaps = jnp.linalg.norm(ends - middles[:, :, None], axis=-1)  # (others, moments, 32)
        slack = (gaps - reach).min(axis=0) - touch
        free = jnp.cumprod(slack > 0, axis=0).sum(axis=0)  # moments until one can touch it
        return jnp.asarray(DIRECTIONS)[jnp.argmax(free + 0.5 * slack.min(axis=0) + 0.05 * slack[-1])]

    def chase(view: TagView) -> Array:
        there = view.position + view.it + view.it_velocity * jnp.minimum(MOMENTS, STRAIGHT)
        gaps = jnp.linalg.norm(paths(view) - jnp.clip(there, -room, room)[:, None], axis=-1)
        late = jnp.cumprod(gaps > touch, axis=0).sum(axis=0)
        return jnp.asarray(DIRECTIONS)[jnp.argmin(late + 0.3 * gaps.min(axis=0))]

    def act(observation: Array, key: Array) -> Array:
        view, others = read(observation), observation[OWN_SIZE + IT_SIZE :].reshape(-1, OTHER_SIZE)
        return jax.lax.select(view.is_it > 0.5, flee(view, others[:, 2:4]), chase(view))

    return act


def noisy(script: Script, length: float, deviation: float) -> Script:
    """Return a script with actions of another length and noise."""
    return lambda observation, key: (
        length * script(observation, key) + deviation * jax.random.normal(jax.random.fold_in(key, 1), (2,))
    )


class MoreScripts(Tag):
    """Tag with the scripts of this experiment."""

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the game's scripts and those of this experiment."""
        own = tag_scripts.of_game(self.rules)
        tagger = own["tagger"][KIND]
        more = {f"tagger ± {s}": noisy(tagger, 1.0, s) for s in DEVIATIONS}
        more |= {f"3 × tagger ± {s}": noisy(tagger, 3.0, s) for s in DEVIATIONS}
        return {**own, **{name: {KIND: script} for name, script in ({"planner": planner(self.rules)} | more).items()}}


def main() -> None:
    """Play all against two taggers and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--episodes", type=int, default=1200, help="of each script, a multiple of 6")
    args = parser.parse_args()
    settings = TagSettings()
    arena = MoreScripts(settings, engine="c", worlds=args.episodes)
    asked = [f"{name}:tagger" for name in arena.scripts() if name != "tagger"]
    played = script_tournament.play(arena, settings, args.episodes, asked=asked)
    found = {
        name: {"score": round(score.score, 4), "low": round(score.low, 4), "high": round(score.high, 4)}
        for (name, _), score in played.one_against_all.items()
    }
    report({**run_info(args.commit), "episodes": args.episodes, "against two taggers": found}, args.out)


if __name__ == "__main__":
    main()
