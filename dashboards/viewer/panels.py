"""The panels beside the world of a match: players, curves over time, events; and the layout of all."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from dashboards.identity import Colour, MatchPlayer, named_events, shape
from dashboards.replay import Replay, distances
from dashboards.viewer.camera import EYE, TARGET, framed_radius
from dashboards.viewer.scene import times
from storage.recordings.recording import Recording

TERM_COLOURS = ((102, 194, 165), (252, 141, 98), (141, 160, 203), (231, 138, 195), (166, 216, 84), (255, 217, 47))
BACKGROUND = (17, 21, 30)
TRAIL = 1.5  # s


def draw_panels(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    """Log the header, all curves and the events."""
    stream.log("header", rr.TextDocument(_markdown(recording, scene), media_type="text/markdown"), static=True)
    for path, name, colour, values in _curves(recording, scene):
        entity = rr.new_entity_path(path)
        stream.log(entity, rr.SeriesLines(colors=[colour], names=[name], widths=[2.0]), static=True)
        stream.send_columns(entity, times(rr, recording), rr.Scalars.columns(scalars=values))
    _draw_events(rr, stream, recording, scene)


def _curves(recording: Recording, scene: Replay) -> Iterator[tuple[list[str], str, Colour, np.ndarray]]:
    """Yield entity path, name, colour and values (T,) of each line; a player's lines have its colour."""
    by_team = {"score": recording.score, "reward": recording.reward}
    by_team |= {f"distance/{name}": values for name, values in distances(recording, scene).items()}
    for team, (name, who) in enumerate(zip(recording.header.teams, scene.players, strict=True)):
        for what, values in by_team.items():
            yield [*what.split("/"), name], f"{who.name} ({name})", who.colour, values[:, team]
        for number, (term, values) in enumerate(recording.terms.items()):
            colour = TERM_COLOURS[number % len(TERM_COLOURS)]  # the same in every team's plot
            yield ["terms", name, term], term, colour, values[:, team]
    for judged, values in recording.values.items():
        who = _player(recording, scene, judged)
        yield ["value", *judged.split("/")], f"{who.name} ({judged})", who.colour, values


def _player(recording: Recording, scene: Replay, judged: str) -> MatchPlayer:
    """Return the player of a team, or of one of its agents."""
    header = recording.header
    named = zip(header.teams, header.agents, scene.players, strict=True)
    return next(who for team, agents, who in named if judged in (team, *agents))


def _draw_events(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    """Log events as lines of a log, and each text as a lane of its own on the timeline, lit for a moment."""
    events = named_events(recording, scene.players)
    if not events:
        return
    steps = np.array([step for step, _ in events])
    text = rr.TextLog.columns(text=[text for _, text in events], level=["INFO"] * len(steps))
    stream.send_columns("events", times(rr, recording, steps), text)
    moment = max(1, recording.steps // 100)
    for text in dict.fromkeys(text for _, text in events):
        lit = np.zeros(recording.steps + 1, bool)
        for step, other in events:
            lit[step : step + moment] |= other == text
        changes = np.flatnonzero(np.diff(lit[:-1], prepend=False))
        states = rr.StateChange.columns(state=[text if lit[step] else "" for step in changes])
        stream.send_columns(rr.new_entity_path(["lanes", text]), times(rr, recording, changes), states)


def _markdown(recording: Recording, scene: Replay) -> str:
    header = recording.header
    sides = zip(header.teams, scene.players, header.score, header.agents, strict=True)
    rows = [
        f"| {who.name} | {who.role} | {who.rating} | {team}, {shape(side)[0]} | {score:g} | {', '.join(agents)} |"
        for side, (team, who, score, agents) in enumerate(sides)
    ]
    where = f"**{header.arena.arena}**, league *{header.league}*, seed {header.seed}, world {header.world}"
    table = ["| player | role | rating before | plays | score | agents |", "|---|---|---|---|---|---|", *rows]
    return "\n".join([f"# {header.outcome}", where, "", *table])


def blueprint(rr: Any, recording: Recording, scene: Replay, panels: bool = True) -> Any:
    """Return the layout: the world on the left, tabs on the right; with `panels` also the viewer's own controls."""
    rrb = rr.blueprint
    plots = _plots(rr, recording, scene)
    return rrb.Blueprint(
        rrb.Horizontal(
            _world(rr, recording, scene),
            rrb.Vertical(
                rrb.TextDocumentView(origin="/header", name="Match"),
                *(rrb.Tabs(*tabs) for tabs in plots),
                rrb.Tabs(*_event_views(rr)),
                row_shares=[1.0, *(1.0 for _ in plots), 0.8],
            ),
            column_shares=[3, 1.3],
        ),
        rrb.TimePanel(
            state="collapsed" if panels else "hidden",
            timeline="sim_time",
            play_state="playing" if panels else "paused",
        ),
        rrb.TopPanel(state="expanded" if panels else "hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _world(rr: Any, recording: Recording, scene: Replay) -> Any:
    rrb, framed = rr.blueprint, framed_radius(scene, np.zeros(3), scene.radius)
    boundary = rrb.TimeRangeBoundary
    lately = rrb.VisibleTimeRange(
        "sim_time", start=boundary.cursor_relative(seconds=-TRAIL), end=boundary.cursor_relative()
    )
    return rrb.Spatial3DView(
        origin="/world",
        name=recording.header.arena.arena,
        overrides={
            rr.new_entity_path(["world", "trails", *robot.agent.split("/")]): rrb.VisibleTimeRanges(lately)
            for robot in scene.robots
        },
        eye_controls=rrb.EyeControls3D(position=EYE * framed, look_target=TARGET * framed, eye_up=(0.0, 0.0, 1.0)),
        # Just above the ground, which would hide its lower half.
        line_grid=rrb.LineGrid3D(
            visible=True,
            spacing=grid_spacing(scene.radius),
            plane=rr.components.Plane3D((0, 0, 1), 0.001 * scene.radius),
            stroke_width=1.0,
            color=(255, 255, 255, 24),
        ),
        background=BACKGROUND,
    )


def _plots(rr: Any, recording: Recording, scene: Replay) -> list[list[Any]]:
    """Return tabs of plots, the most informative first: distances to edge or ball, then the terms of the teams'
    rewards.
    """
    rrb = rr.blueprint

    def plot(path: list[str], name: str) -> Any:
        origin = rr.new_entity_path(path)
        return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.Corner2D.LeftTop)

    far = [plot(["distance", name], f"Distance to {name}, m") for name in distances(recording, scene)]
    terms = [plot(["terms", team], f"Terms of {team}") for team in recording.header.teams if recording.terms]
    worth = [plot(["value"], "Value estimates")] if recording.values else []
    return [[*far, *worth, plot(["score"], "Score")], [*terms, plot(["reward"], "Reward")]]


def _event_views(rr: Any) -> list[Any]:
    rrb = rr.blueprint
    body = rrb.encodings.TextLogColumn(rrb.encodings.TextLogColumnKind.Body)
    return [
        rrb.TextLogView(origin="/events", name="Events", columns=rrb.TextLogColumns(text_log_columns=[body])),
        rrb.StateTimelineView(origin="/lanes", name="Time line"),
    ]


def grid_spacing(radius: float) -> float:
    """Return about a sixth of the arena's size, rounded: 1, 2 or 5 times a power of ten, m."""
    power = 10.0 ** math.floor(math.log10(radius / 3))
    return power * max(step for step in (1, 2, 5) if step * power <= radius / 3)
