"""A league's figures as values, in Plotly's form: `{"data": [...], "layout": {...}}`.

They set no colour of paper, text or grid: the page sets those, for its reader's dark or light theme.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Figure = dict[str, Any]
Rows = Sequence[Mapping[str, Any]]
Line = tuple[Sequence[float], Sequence[float]]
"""Points in order, as x and y."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#e69f00", "#8c6bb1", "#cc79a7", "#56b4e9", "#7f7f7f")
"""Colours that most colour-blind readers can distinguish, on dark and light (Okabe and Ito's, except for two).

By a player's number they are as like as may be to those in films (`dashboards.identity`): blue, red, green, yellow."""
DASHES = ("solid", "dash", "dot", "dashdot")  # with more players than colours
SYMBOLS = ("circle", "diamond", "square", "triangle-up")  # of markers, one for each dash
SCORES = [[0.0, "#d55e00"], [0.5, "#e8e8e8"], [1.0, "#0072b2"]]
POINTS = 400
"""Maximum number of points of a line: more could not be distinguished."""
BARS = 40
"""Maximum number of rows of a figure with one row for each snapshot."""
CELLS = 100
"""Maximum number of rows and columns of a heat map."""


def ladder(rows: Rows, merit: str = "elo", players: Sequence[str] = ()) -> Figure:
    """Return the best-rated snapshots with their 95 % intervals, the best on top.

    Args:
        rows: best first, with `name`, `player` (None for a script), the merit, and its bounds: `low` and `high`, or
            `success_low` and `success_high`.
        merit: `elo` or `success`.
        players: see `_styles`.
    """
    low, high = bounds(merit)
    shown = [row for row in rows if row[merit] is not None][:BARS]
    traces = []
    for owner, style in _styles((row["player"] for row in shown), players).items():
        own = [row for row in shown if row["player"] == owner]
        traces.append({
            "type": "scatter", "mode": "markers", "name": owner or "fixed",
            "x": [row[merit] for row in own], "y": [row["name"] for row in own],
            "error_x": {
                "type": "data", "symmetric": False, "array": [row[high] - row[merit] for row in own],
                "arrayminus": [row[merit] - row[low] for row in own],
            },
            "marker": {"color": style["color"], "symbol": SYMBOLS[DASHES.index(style["dash"])], "size": 8},
        })  # fmt: skip
    order = [row["name"] for row in reversed(shown)]
    return _figure(
        traces, merit.capitalize(), "", 110 + 20 * len(order),
        yaxis={"type": "category", "categoryorder": "array", "categoryarray": order, "dtick": 1, "automargin": True},
    )  # fmt: skip


def ratings(rows: Rows, merit: str = "elo", players: Sequence[str] = ()) -> Figure:
    """Return ratings over the training steps of each player, with 95 % bands; fixed players as level lines.

    Args:
        rows: in any order, as for `ladder`, with `steps` (environment steps; None for a fixed player).
        merit: `elo` or `success`.
        players: see `_styles`.
    """
    low, high = bounds(merit)
    rated = [row for row in rows if row[merit] is not None]
    learnt = sorted((row for row in rated if row["steps"] is not None), key=lambda row: row["steps"])
    traces = []
    for owner, style in _styles((row["player"] for row in learnt), players).items():
        own = [row for row in learnt if row["player"] == owner]
        x = [row["steps"] for row in own]
        band = [row[high] for row in own] + [row[low] for row in reversed(own)]
        traces.append({
            "type": "scatter", "mode": "lines", "x": [*x, *reversed(x)], "y": band, "fill": "toself",
            "fillcolor": _faint(style["color"]), "line": {"width": 0}, "hoverinfo": "skip", "showlegend": False,
            "legendgroup": owner,
        })  # fmt: skip
        traces.append({
            "type": "scatter", "mode": "lines+markers", "name": owner, "legendgroup": owner, "x": x,
            "y": [row[merit] for row in own], "text": [row["name"] for row in own], "line": style,
            "hovertemplate": "%{text}: %{y:.4g}<extra></extra>",
        })  # fmt: skip
    ends = [0, max((row["steps"] for row in learnt), default=1)]
    level = [
        {"type": "scatter", "mode": "lines", "name": row["name"], "x": ends, "y": [row[merit]] * 2,
         "line": {"color": COLOURS[-1], "dash": DASHES[1 + i % 3], "width": 1}}
        for i, row in enumerate(row for row in rated if row["steps"] is None)
    ]  # fmt: skip
    return _figure([*traces, *level], "training steps of the player", merit.capitalize())


def payoff(rows: Sequence[str], columns: Sequence[str], scores: np.ndarray, games: np.ndarray) -> Figure:
    """Return scores of rows against columns as a heat map; pairs that have not met are left blank.

    Args:
        rows: (N,) names, the first on top.
        columns: (M,) names.
        scores: (N, M) in [0, 1], nan for pairs that have not met.
        games: (N, M) numbers of games played.
    """
    cells = [[None if math.isnan(x) else round(x, 4) for x in row] for row in scores.tolist()]
    heat = {
        "type": "heatmap", "x": list(columns), "y": list(rows), "z": cells, "zmin": 0, "zmax": 1, "customdata":
        games.tolist(), "colorscale": SCORES, "hoverongaps": False, "colorbar": {"title": {"text": "score"}},
        "hovertemplate": "%{y} against %{x}: %{z:.3f} of %{customdata} games<extra></extra>",
    }  # fmt: skip
    names = {"type": "category", "automargin": True, "showgrid": False}
    return _figure(
        [heat], "against", "", min(900, 180 + 20 * len(rows)), hovermode="closest",
        xaxis={**names, "tickangle": -60}, yaxis={**names, "autorange": "reversed"},
    )  # fmt: skip


def mixture(opponents: Rows) -> Figure:
    """Return the probability with which a learner meets each opponent, the likeliest first.

    Args:
        opponents: with `opponent`, `probability` and `present`, True for a learning player in its current state.
    """
    met = sorted((row for row in opponents if row["probability"] > 0), key=lambda row: -row["probability"])
    shown, rest = met[:BARS], sum(row["probability"] for row in met[BARS:])
    names = [row["opponent"] + (" (as it is now)" if row["present"] else "") for row in shown]
    values = [row["probability"] for row in shown]
    if rest:
        names, values = [*names, f"{len(met) - BARS:,} others"], [*values, rest]
    bars = {
        "type": "bar", "orientation": "h", "x": values, "y": names, "marker": {"color": COLOURS[0]},
        "hovertemplate": "%{y}: %{x:.3f}<extra></extra>",
    }  # fmt: skip
    axis = {"type": "category", "autorange": "reversed", "dtick": 1, "automargin": True}
    return _figure([bars], "probability", "", 110 + 20 * len(names), yaxis=axis, showlegend=False)


def curves(
    lines: Mapping[str, Line], title: str, across: str = "training steps", players: Sequence[str] = ()
) -> Figure:
    """Return a recorded metric of learning over steps, a line for each player.

    Args:
        lines: by player; y is the metric.
        title: the metric's name on the page.
        across: the title of the horizontal axis.
        players: see `_styles`.
    """
    traces = []
    for owner, style in _styles(lines, players).items():
        x, y = thinned(*lines.get(owner or "", ((), ())))
        traces.append({"type": "scatter", "mode": "lines", "name": owner, "x": x, "y": y, "line": style})
    return _figure(traces, across, title, 320)


def bands(points: Rows, title: str, over: str = "steps", across: str = "training steps") -> Figure:
    """Return means over steps, a line for each cell, with a band from the lowest to the highest.

    Args:
        points: in order, with `cell`, `mean`, `low`, `high` and `over`.
        title: the metric's name on the page.
        over: the key of the horizontal axis.
        across: the title of the horizontal axis.
    """
    traces = []
    for cell, style in _styles(point["cell"] for point in points).items():
        own = [p for p in points if p["cell"] == cell]
        x = [p[over] for p in own]
        traces.append({
            "type": "scatter", "mode": "lines", "x": [*x, *reversed(x)],
            "y": [p["high"] for p in own] + [p["low"] for p in reversed(own)], "fill": "toself",
            "fillcolor": _faint(style["color"]), "line": {"width": 0}, "hoverinfo": "skip", "showlegend": False,
            "legendgroup": cell,
        })  # fmt: skip
        traces.append({
            "type": "scatter", "mode": "lines", "name": cell, "legendgroup": cell, "x": x,
            "y": [p["mean"] for p in own], "line": style,
        })  # fmt: skip
    return _figure(traces, across, title)


def lineage(snapshots: Rows, players: Sequence[str] = ()) -> Figure:
    """Return the ancestry of snapshots: a row for each player, a line from each snapshot to its parent.

    Args:
        snapshots: with `name`, `player` (None without a player), `parent` (a name or None) and `steps`.
        players: see `_styles`.
    """
    place = {s["name"]: (s["steps"], s["player"] or "fixed") for s in snapshots}
    ends = [(place[s["parent"]], place[s["name"]]) for s in snapshots if s["parent"] in place]
    lines = {
        "type": "scatter", "mode": "lines", "hoverinfo": "skip", "showlegend": False,
        "line": {"color": COLOURS[-1], "width": 1},
        "x": [x for a, b in ends for x in (a[0], b[0], None)], "y": [y for a, b in ends for y in (a[1], b[1], None)],
    }  # fmt: skip
    traces = [lines]
    for owner, style in _styles((s["player"] for s in snapshots), players).items():
        own = [s for s in snapshots if s["player"] == owner]
        traces.append({
            "type": "scatter", "mode": "markers", "name": owner or "fixed", "x": [s["steps"] for s in own],
            "y": [owner or "fixed"] * len(own), "text": [s["name"] for s in own],
            "customdata": [s["parent"] or "nobody" for s in own], "marker": {"color": style["color"], "size": 8},
            "hovertemplate": "%{text}, from %{customdata}<extra></extra>",
        })  # fmt: skip
    lanes = len(dict.fromkeys(y for _, y in place.values()))
    axis = {"type": "category", "automargin": True}
    return _figure(traces, "training steps of the player", "", 140 + 40 * lanes, yaxis=axis, hovermode="closest")


def compact(figure: Figure, height: int) -> Figure:
    """Return a figure for a place of `height` pixels: without titles of axes, its legend above."""
    layout = dict(figure["layout"])
    for axis in ("xaxis", "yaxis"):
        layout[axis] = {key: value for key, value in layout[axis].items() if key != "title"}
    legend = {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"}
    margin = {"l": 45, "r": 10, "t": 30, "b": 30}
    return {**figure, "layout": {**layout, "height": height, "margin": margin, "legend": legend}}


def bounds(merit: str) -> tuple[str, str]:
    """Return the keys of a merit's 95 % interval in a row of ratings."""
    return ("low", "high") if merit == "elo" else (f"{merit}_low", f"{merit}_high")


def thinned(x: Sequence[float], y: Sequence[float], most: int = POINTS) -> tuple[list[float], list[float]]:
    """Return a line of at most `most` points: means of y over groups of neighbours, at the last x of each group."""
    size = -(-len(x) // most) or 1
    starts = range(0, len(x), size)
    groups = (y[i : i + size] for i in starts)
    return [x[min(i + size, len(x)) - 1] for i in starts], [sum(group) / len(group) for group in groups]


def _styles(owners: Iterable[str | None], players: Sequence[str] = ()) -> dict[str | None, dict[str, Any]]:
    """Return each owner's line style.

    All players of a league, in its order, have the same styles in all its figures, and the colours of its films; other
    owners follow in order of names.
    """
    named = dict.fromkeys((*players, *sorted({owner for owner in owners if owner is not None})))
    styles: dict[str | None, dict[str, Any]] = {
        name: {"color": COLOURS[i % 7], "dash": DASHES[i // 7 % 4], "width": 2} for i, name in enumerate(named)
    }
    return styles | {None: {"color": COLOURS[-1], "dash": "dot", "width": 1}}


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"


def _figure(traces: list[dict[str, Any]], across: str, up: str, height: int = 420, **layout: Any) -> Figure:
    axes = {
        axis: {"title": {"text": text}, **layout.pop(axis, {})} for axis, text in (("xaxis", across), ("yaxis", up))
    }
    margin = {"l": 60, "r": 20, "t": 20, "b": 50}
    return {
        "data": [trace for trace in traces if "z" in trace or len(trace["x"])],
        "layout": {"height": height, "margin": margin, "hovermode": "closest", "autosize": True, **axes, **layout},
    }
