"""Pictures for the pages of arenas: a match between scripts, played, recorded and drawn as by `league watch --shot`.

    python -m scripts.arena_pictures                       # all, into docs/pictures/arenas
    python -m scripts.arena_pictures sumo-1v1 --look 8     # list events in matches of eight seeds
    python -m scripts.arena_pictures sumo-1v1              # only this one

It needs a Vulkan driver.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import arenas
from agents.rollout.rollout import make_play, scripts_for
from dashboards import viewer
from dashboards.replay import replay
from league.matches.episode_recording import episode
from league.queries import arena_info
from league.snapshots.codec import seat
from storage.recordings.recording import Recording
from storage.records import Snapshot

ROOT = Path(__file__).parents[1]


class Shot(NamedTuple):
    """The scripts that play, the seed, and the moment in seconds."""

    scripts: tuple[str, ...]  # by team
    seed: int
    at: float


SHOTS = {
    "sumo-1v1": Shot(("pusher", "centre-holder"), 3, 6.7),
    "sumo-2v2": Shot(("pusher", "centre-holder"), 2, 6.0),
    "sumo-by-team": Shot(("pusher", "pusher"), 0, 5.0),
    "sumo-within-team": Shot(("pusher", "pusher"), 0, 6.0),
    "sumo-2v2-anymal": Shot(("pusher", "pusher"), 1, 14.0),
    "sumo-2v2-leatherback": Shot(("pusher", "pusher"), 0, 6.1),
    "sumo-1v1-anymal": Shot(("pusher", "pusher"), 4, 13.0),
    "sumo-1v1-leatherback": Shot(("pusher", "pusher"), 0, 15.0),
    "anymal-walk": Shot(("seeker",), 2, 16.0),
    "walk": Shot(("seeker",), 2, 12.0),
    "disturbance": Shot(("seeker", "headwind"), 2, 8.0),
    "block-push-anymal": Shot(("pusher", "pusher"), 2, 8.0),
    "block-push-leatherback": Shot(("pusher", "pusher"), 1, 3.2),
    "galaga-aim-1v1": Shot(("gunner",), 0, 0.2),
    "galaga-aim-2v2": Shot(("gunner",), 1, 0.5),
    "galaga-fly-1v1": Shot(("flyer",), 8, 1.2),
    "galaga-fly-2v2": Shot(("flyer",), 1, 1.2),
    "galaga-1v1": Shot(("gunner", "flyer"), 2, 0.56),
    "galaga-2v2": Shot(("gunner", "flyer"), 7, 1.24),
    "tag": Shot(("tagger", "tagger", "tagger"), 2, 5.6),
    "gate-race": Shot(("pilot", "cadet"), 0, 1.0),
    "gate-race-4": Shot(("pilot", "pilot", "cadet", "cadet"), 1, 1.2),
    "pursuit": Shot(("interceptor", "runner"), 0, 2.0),
    "swarm": Shot(("dodger", "keeper"), 1, 3.5),
    "soccer-walk": Shot(("seeker",), 2, 16.0),
    "soccer-ball": Shot(("striker",), 0, 5.0),
    "soccer-score": Shot(("striker",), 0, 10.0),
    "soccer-score-leatherback": Shot(("striker",), 1, 8.5),
    "soccer-1v1": Shot(("striker", "striker"), 0, 6.8),
    "soccer-2v2": Shot(("striker", "striker"), 0, 8.0),
    "soccer-2v2-leatherback": Shot(("striker", "keeper"), 0, 7.3),
    "run-to-goal": Shot(("walk", "random"), 1, 6.0),
    "run-to-goal-humanoids": Shot(("idle", "idle"), 0, 0.5),
    "sumo-ants": Shot(("walk", "stand"), 0, 5.0),
    "sumo-humanoids": Shot(("idle", "idle"), 0, 0.5),
    "you-shall-not-pass": Shot(("idle", "idle"), 0, 0.5),
    "kick-and-defend": Shot(("idle", "idle"), 0, 0.5),
    "rock-paper-scissors": Shot(("rock", "paper"), 0, 1.0),
    "matching-pennies": Shot(("heads", "tails"), 0, 1.0),
    "kuhn-poker": Shot(("bet", "bet"), 0, 2.0),
    "leduc-poker": Shot(("raise", "call"), 0, 3.0),
    "dark-hex-3": Shot(("random", "random"), 0, 5.0),
}


def play(name: str, scripts: tuple[str, ...], seeds: Sequence[int]) -> list[Recording]:
    """Record one episode for each seed, one at a time, so that a seed always gives the same match."""
    arena = arenas.load(name, engine="c", worlds=1, threads=1)
    seats = [
        [[list(scripts_for(arena, agent.kind)).index(script) for agent in team.agents]]
        for team, script in zip(arena.teams, scripts, strict=True)
    ]
    play_one, stacks = make_play(arena, (0,)), seat(arena.teams, seats)
    sides = [
        Snapshot("pictures", script, "", team.roster, script=script)
        for team, script in zip(arena.teams, scripts, strict=True)
    ]
    games = [jax.device_get(play_one(stacks, jax.random.key(seed)[None])) for seed in seeds]
    return [episode(arena, game, 0, sides, "pictures", seed, 0) for game, seed in zip(games, seeds, strict=True)]


def story(recording: Recording) -> str:
    """Describe a match: events, and for every second the smallest distance between robots and props."""
    scene = replay(recording)
    roots = [body for body in range(1, scene.model.nbody) if scene.model.body_parentid[body] == 0]
    at = scene.xpos[:, roots]
    gaps = np.linalg.norm(at[:, :, None] - at[:, None], axis=-1) + 99 * np.eye(len(roots))
    seconds = np.unique(np.searchsorted(recording.time, np.arange(1, recording.time[-1] + 1)).clip(0, len(at) - 1))
    near = [f"{gap:.1f}" for gap in gaps.min(axis=(1, 2))[seconds]] if len(roots) > 1 else []
    parts = [f"{recording.time[step]:.2f} s {text}" for step, text in recording.events]
    parts += [f"{name} {np.round(values[0], 2).tolist()}" for name, values in recording.markers.items()]
    return "; ".join([*parts, f"nearest each second {' '.join(near)}"])


def main() -> None:
    """Draw the pictures, or list what happens in matches."""
    asked = argparse.ArgumentParser(description="Pictures of scripted matches for the pages of arenas.")
    asked.add_argument("names", nargs="*", default=list(SHOTS))
    asked.add_argument("--look", type=int, help="draw nothing; list what happens with this many seeds")
    options = asked.parse_args()
    for name in options.names:
        shot = SHOTS[name]
        if options.look:
            print(f"{name}: {' against '.join(shot.scripts)}")
            for recording in play(name, shot.scripts, range(options.look)):
                print(f"  seed {recording.header.seed}: {story(recording)}")
            continue
        file = ROOT / arena_info.sheet(arenas.settings(name)).picture
        file.parent.mkdir(parents=True, exist_ok=True)
        viewer.screenshot(play(name, shot.scripts, [shot.seed])[0], file, shot.at, size=(1280, 800))


if __name__ == "__main__":
    main()
