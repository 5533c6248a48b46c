"""Log-log pictures of error against cost: the mean over all scenes, then one panel a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jax2d.fidelity.frontier import Point, accepted, bounded, pareto_set, points_of, setting_key, slope
from jax2d.fidelity.peers import PEER_NAMES
from jax2d.fidelity.records import Record, is_preset_itself

COLOURS = {
    "standard": "#1f77b4",
    "paper": "#d62728",
    "draft": "#ff7f0e",
    "fine": "#2ca02c",
    "published-jax2d": "#7f3c8d",
    "box2d": "#333333",
}
OTHER_COLOUR = "#8c8c8c"
MARKS = {("warp", "float32"): "o", ("xla", "float32"): "s", ("xla", "float64"): "D", ("box2d", "float32"): "^"}
COLUMNS = 6


def draw(records: Sequence[Record], file: Path, *, title: str) -> None:
    """Writes the picture; the format follows the file's ending."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scenes = list(dict.fromkeys(record["scene"] for record in records))
    rows = -(-len(scenes) // COLUMNS)
    figure = plt.figure(figsize=(18, 9 + 2.6 * rows), layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(9, 2.6 * rows)).flat
    _mean_panel(top.subplots(), records, title)
    panels = bottom.subplots(rows, COLUMNS, squeeze=False).flat
    for panel, scene in zip(panels, scenes):
        _scene_panel(panel, scene, [record for record in records if record["scene"] == scene])
    for panel in list(bottom.axes)[len(scenes) :]:
        panel.set_axis_off()
    figure.savefig(file, dpi=80)
    plt.close(figure)


def _mean_panel(panel: Any, records: Sequence[Record], title: str) -> None:
    points = points_of(records)
    own = {setting_key(record): is_preset_itself(record) for record in records}
    for preset in dict.fromkeys(point.preset for point in points):
        for (backend, dtype), mark in MARKS.items():
            these = [p for p in points if (p.preset, p.backend, p.dtype) == (preset, backend, dtype)]
            if these:
                label = preset if (backend, dtype) == ("warp", "float32") else f"{preset} ({backend} {dtype})"
                colour = COLOURS.get(preset, OTHER_COLOUR)
                panel.plot(
                    [p.cost for p in these], [p.error for p in these], mark, color=colour, label=label, alpha=0.8
                )
    front = [points[i] for i in pareto_set([(p.cost, p.error) for p in points])]
    steepness = slope([p.cost for p in front], [p.error for p in front])
    panel.plot(
        [p.cost for p in front],
        [p.error for p in front],
        "-",
        color="black",
        linewidth=1,
        zorder=0,
        label=f"Pareto set, slope {steepness:.2f}: twice the time leaves {2**steepness:.2f} of the error",
    )
    named = {key for key, itself in own.items() if itself and key[2] == "float32"}  # float64 lies beside it
    for peer in PEER_NAMES:  # a peer is named at its first setting
        named |= set([point[:4] for point in points if point.preset == peer][:1])
    dearest = max(point.cost for point in points)
    for point in points:
        if point[:4] in named or point in front:
            _name(panel, point, in_full=point[:4] in named, to_the_left=point.cost > dearest / 3)
    panel.set(xscale="log", yscale="log", title=title)
    panel.set_xlabel("microseconds per simulated world-second (geometric mean over scenes)")
    panel.set_ylabel("error (geometric mean over scenes)")
    panel.grid(True, which="both", alpha=0.2)
    panel.legend(loc="best", fontsize=9)


def _name(panel: Any, point: Point, *, in_full: bool, to_the_left: bool) -> None:
    text = f"{point.preset}: {point.setting}" if in_full else point.setting
    panel.annotate(
        text,
        (point.cost, point.error),
        textcoords="offset points",
        xytext=(-6, 5) if to_the_left else (6, 5),
        horizontalalignment="right" if to_the_left else "left",
        fontsize=11 if in_full else 8,
        fontweight="bold" if in_full else "normal",
        color=COLOURS.get(point.preset, OTHER_COLOUR),
    )


def _scene_panel(panel: Any, scene: str, records: Sequence[Record]) -> None:
    spots = [(record["us_per_world_second"], bounded(record["error"])) for record in records]
    for record, (cost, error) in zip(records, spots):
        mark = MARKS.get((record["backend"], record["dtype"]), "o")
        size = 9 if is_preset_itself(record) else 4
        colour = COLOURS.get(record["preset"], OTHER_COLOUR)
        face = colour if accepted(record) else "none"  # hollow: not accepted
        panel.plot(cost, error, mark, color=colour, markerfacecolor=face, markersize=size, alpha=0.7)
    trusted = [spot for record, spot in zip(records, spots) if accepted(record)]
    if front := [trusted[i] for i in pareto_set(trusted)]:
        panel.plot(*zip(*front), "-", color="black", linewidth=0.8, zorder=0)
    panel.set(xscale="log", yscale="log")
    panel.set_title(scene, fontsize=9)
    panel.set_ylabel(records[0]["metric"].split(" (")[0].split(" / ")[0][:34], fontsize=6)
    panel.tick_params(labelsize=6)
    panel.tick_params(which="minor", labelleft=False, labelbottom=False)
    panel.grid(True, alpha=0.2)
