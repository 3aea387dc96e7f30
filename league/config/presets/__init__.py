"""Presets: named configurations to start from."""

import difflib
from collections.abc import Callable, Mapping

from league.config.experiment import Config
from league.config.presets import harl_a, hidden_information, over_skills, quick_starts, related_work, team_games
from league.config.schema import ConfigError

PRESETS: Mapping[str, Callable[[], Config]] = {
    "quickstart": quick_starts.quickstart,
    "duel": quick_starts.duel,
    "rovers": quick_starts.rovers,
    "tag": team_games.tag,
    "selfplay": quick_starts.selfplay,
    "leapfrog": quick_starts.leapfrog,
    "alphastar": quick_starts.alphastar,
    "psro": quick_starts.psro,
    "openai-five": quick_starts.openai_five,
    "delta-uniform": quick_starts.delta_uniform,
    "kuhn-poker": hidden_information.kuhn_poker,
    "leduc-poker": hidden_information.leduc_poker,
    "harl_a": harl_a.harl_a,
    "walk": harl_a.walk,
    "sumo-by-team": harl_a.by_team,
    "sumo-within-team": harl_a.within_team,
    "hopper-alone": related_work.hopper_alone,
    "hopper-adversary": related_work.hopper_adversary,
    "hopper-adversaries": related_work.hopper_adversaries,
    "soccer-1v1": harl_a.soccer_1v1,
    "soccer-2v2": harl_a.soccer_2v2,
    "soccer-2v2-skills": over_skills.soccer_2v2,
    "sumo-by-team-skills": over_skills.sumo_by_team,
    "sumo-within-team-skills": over_skills.sumo_within_team,
    "galaga-1v1": harl_a.galaga_1v1,
    "galaga-2v2": harl_a.galaga_2v2,
    "run-to-goal": related_work.run_to_goal,
    "sumo-ants": related_work.sumo_ants,
    "sumo-humanoids": related_work.sumo_humanoids,
    "you-shall-not-pass": related_work.you_shall_not_pass,
    "kick-and-defend": related_work.kick_and_defend,
    "gate-race": team_games.gate_race,
    "gate-race-sparse": team_games.gate_race_sparse,
    "gate-race-4": team_games.gate_race_4,
    "swarm": team_games.swarm,
}


def preset(name: str) -> Config:
    """Return a preset by name. Raises ConfigError, one line with the nearest name or else all, for an unknown name."""
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, 1)
        if near:
            raise ConfigError(
                ("preset",), f"unknown preset {name!r}: did you mean {near[0]}? (`league presets` lists all)"
            )
        known = f"presets: {', '.join(PRESETS)}; `league presets` tells what each is"
        raise ConfigError(("preset",), f"unknown preset {name!r} ({known})")
    return PRESETS[name]()
