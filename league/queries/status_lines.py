"""Lines of a league's status: the ends of turns and generations, failures and their causes, shares and sizes."""

from collections.abc import Mapping, Sequence

from league.queries.query import score_text
from league.scheduling.player_resets import Generation, current_generation
from league.state.league_state import LeagueState
from league.system.devices import Memory
from matchmaking.roles import Role
from matchmaking.schedule import LearningCounts, remaining
from storage.records import Job, Phase, Player


def phase_line(phase: Phase, state: LeagueState) -> str:
    """Name the learners of a turn, the iteration at which it began and the rule that ends it."""
    left = remaining(phase, {name: LearningCounts(at.iteration, at.step) for name, at in state.checkpoints.items()})
    since = ", ".join(dict.fromkeys(str(phase.since.get(name, 0)) for name in phase.learners))
    if left is None:
        end = "nothing ends it"
    elif "step" in phase.until:
        end = f"it ends at step {phase.until['step']:,}, {left:,} are left"
    else:
        end = f"it ends after {phase.until['iterations']} iterations, {left} are left"
    if "score" in phase.until:
        score = state.scores[phase.learners[0]]
        now = f"it scores {score_text(score)}" if score.games else "no episode has ended yet"
        sure = f"surely scores above {100 * phase.until['score']:g} %: {now}"
        over = score.low > phase.until["score"]
        end = f"its turn is over, for it {sure}" if over else f"{end}, or before that when it {sure}"
    verb = "learns" if len(phase.learners) == 1 else "learn"
    return f"group {phase.group}: {' and '.join(phase.learners)} {verb} since iteration {since}; {end}"


def generation(player: Player, now: Generation) -> str:
    """Describe the start of a player's generation, the rule that ends it, and what follows."""
    role, ends = now.role, []
    if role.win_rate is not None:
        least = min(now.scores.items(), key=lambda item: item[1].low, default=None)
        text = "nobody is there yet" if least is None else f"least sure against {least[0]}, {score_text(least[1])}"
        ends.append(f"it surely scores above {100 * role.win_rate:g} % against all {len(now.scores)} it meets ({text})")
    if role.timeout is not None:
        ends.append(f"after {role.timeout:,} steps ({now.left:,} are left)")
    text = f"{player.name} ({role.name}) since {now.since.name}: frozen when {' or '.join(ends)}"
    if not role.can_reset:
        return text
    source = "its first policy" if role.reset == "initial" else "the newest main player"
    chance = "" if role.reset_chance in (None, 1) else f", with probability {role.reset_chance:g}"
    return f"{text}; then it is reset to {source}{chance}"


def generations(roles: Mapping[str, Role], state: LeagueState) -> list[str]:
    """Describe the current generation of each player whose role has generations."""
    now = [
        (p, current_generation(roles[p.name], state, p, state.checkpoints[p.name].step))
        for p in state.players
        if p.name in roles
    ]
    return [generation(player, each) for player, each in now if each is not None]


def failed_job(job: Job, whole: bool) -> str:
    """Name a job with the number of attempts and the last error, whole or its first line."""
    return f"{job.key}, tried {job.failures} times: {error(job.error, whole)}"


def error(error: str | None, whole: bool) -> str:
    """Return all lines of an error, or the first line and a hint how to see the others."""
    lines = (error or "no reason was given").strip().splitlines()
    if whole or len(lines) == 1:
        return "\n    ".join(lines)
    return f"{lines[0]} (--debug shows it all)"


def rating_share(share: float, trained: float, rated: float, episodes: int = 0) -> str:
    """Describe the requested share and the actual share of `rated` device seconds.

    With `episodes` played in these seconds, add the episodes per second of a device.
    """
    asked = "as much as they get" if share == 1.0 else f"{100 * share:.3g} %"
    if not trained:
        return f"nobody has learnt yet (rating.share: {asked})"
    speed = episodes / rated if rated else 0.0
    pace = f", {speed:{',.0f' if speed >= 100 else '.3g'}} games per second of a device" if speed else ""
    return f"{100 * rated / trained:.3g} % of the time of the devices that train (rating.share: {asked}){pace}"


def machine(free_disk: float | None, gpus: Sequence[Memory]) -> str:
    """Describe the free disk space for a store on this machine, and the memory of its GPUs in use."""
    disk = [f"Disk: {free_disk / 1e9:,.1f} GB free"] if free_disk is not None else []
    memory = [f"{gpu.used:.1f} of {gpu.total:.1f} GB of GPU {gpu.name} in use" for gpu in gpus]
    return "; ".join([*disk, *memory]) or "Disk: not of this machine"
