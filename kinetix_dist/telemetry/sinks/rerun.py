"""Rollouts to rerun: a file (.rrd) with its layout inside, or a viewer that is running.

Whole rollouts go in as columns (`send_columns`), made on demand from a recording. rerun has no filled 2D
polygon, so shapes are meshes in 3D, seen by a `Pinhole` camera inside a 2D view:

    /camera               the pinhole: LENS pixels focal length; a 2D view with this origin projects the rest
    /world                metres to camera space: x right, y down, LENS away, so that 1 m is PIXELS_PER_METRE pixels
    /world/shape_03       moves (Transform3D columns); below it, in its own frame, its primitives of the display list:
                          `part_0`, and of what is fixed to it `joint_0/part_0`, `thruster_0/part_0`, ...
    /world/joint_0/part_0     what moves with no body: crosses of welds, rails without ends, springs
    /reward /return /motor /thruster /actions     plots
    /action_words         the same actions by their names, "motor colour 0: forward", where one changes
    /summary              what this rollout is

Bodies are outside of /camera because rerun leaves out what is below a pinhole of the view's own origin.
Every row carries two timelines: `step` and `time` (simulated seconds).
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from jax2d.display_list import (
    DISC,
    JOINT,
    LINE,
    POLYGON,
    SHAPE,
    DisplayList,
    Primitive,
    display_list,
    world_points,
)
from jax2d.palette import BACKGROUND, HINGE, MOTOR_PALETTE, THRUSTER_PALETTE, Colour
from jax2d.rasteriser import DEFAULT_VIEW
from kinetix_dist.child_python import command_of
from kinetix_dist.errors import one_line
from kinetix_dist.telemetry.recording import Rollout

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "kinetix-dist"
CONNECT_SECONDS = 10.0
START_SECONDS = 60.0  # of the process that sends, on a busy machine
LENS = 20000.0  # focal length, pixels, and distance: long, so that depth moves nothing by a pixel
PIXELS_PER_METRE = 100.0
CIRCLE_CORNERS = 48
# Depths, camera units nearer than the plane of the shapes: lines of a shape behind another must not shine through.
SHAPE_SPACING, OUTLINE_DEPTH, MARK_DEPTH = 1.0, 0.2, 40.0
PART_DEPTH = 0.02  # of a primitive of a body over the one before it
REWARD_COLOUR, RETURN_COLOUR = (240, 170, 50), (90, 170, 250)
ACTION_PALETTE = MOTOR_PALETTE + THRUSTER_PALETTE  # of six action dimensions: four motor colours, two thruster colours
MOTOR_FORWARD, MOTOR_BACKWARD = MOTOR_PALETTE[0], MOTOR_PALETTE[1]


def rollout_to_rrd(rollout: Rollout, path: str | os.PathLike[str]) -> None:
    """Writes one rollout and its layout to an .rrd file, replacing a file of that name."""
    import rerun as rr

    if not Path(path).parent.is_dir():  # rerun itself would only log a warning
        raise FileNotFoundError(f"{Path(path).parent} is no directory; create it or choose another path for the .rrd")
    try:
        with rr.RecordingStream(APPLICATION, recording_id=_recording_id(rollout), send_properties=False) as stream:
            stream.save(Path(path), default_blueprint=rollout_blueprint(rollout))
            log_rollout(stream, rollout)
            stream.flush()
            stream.disconnect()
    except RuntimeError as error:  # all that rerun raises when it cannot write
        raise OSError(f"{os.fspath(path)} cannot be written: {error}") from error


def rollout_to_viewer(rollout: Rollout, url: str = "rerun+http://127.0.0.1:9876/proxy") -> None:
    """Shows one rollout in a rerun viewer that listens at `url` (`rerun --bind 127.0.0.1`).

    Raises ConnectionError when none takes it within CONNECT_SECONDS. A process of its own sends it: where something
    takes the connection and nothing else, rerun waits for ever, also to give the stream up and to end its process.
    """
    command, limit_s = command_of(__name__, url, CONNECT_SECONDS), START_SECONDS + CONNECT_SECONDS
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    try:
        done = subprocess.run(
            command, input=pickle.dumps(rollout), stdout=subprocess.PIPE, env=environment, timeout=limit_s, check=False
        )
        reason = done.stdout.decode(errors="replace").strip() or f"exit status {done.returncode}"
    except subprocess.TimeoutExpired:
        reason = f"nothing was taken within {limit_s:g} s"
    else:
        if done.returncode == 0:
            return
    raise ConnectionError(f"no rerun viewer answers at {url} ({reason}); start `rerun --bind 127.0.0.1`")


def _send(rollout: Rollout, url: str, seconds: float) -> None:
    """Work of that process, which ends here where it fails, with the reason on stdout."""
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION, recording_id=_recording_id(rollout), send_properties=False)
    try:
        stream.connect_grpc(url, default_blueprint=rollout_blueprint(rollout))
        log_rollout(stream, rollout)
        stream.flush(timeout_sec=seconds)
        stream.disconnect()
    except (RuntimeError, ValueError) as error:
        sys.stdout.write(one_line(error))
        sys.stdout.flush()
        os._exit(1)


def log_rollout(stream: rr.RecordingStream, rollout: Rollout) -> None:
    """Logs everything but the layout."""
    import rerun as rr

    stream.send_recording_name(f"{rollout.level_name}: {rollout.outcome}")
    stream.log("summary", rr.TextDocument(summary(rollout), media_type=rr.MediaType.MARKDOWN), static=True)
    _log_camera(stream)
    scene = rollout.level.scene
    for i in np.flatnonzero(np.asarray(scene.shapes.active)):
        _log_body(stream, rollout, int(i))
    _log_display(stream, rollout, display_list(scene, rollout.level.shape_role))
    _log_plots(stream, rollout)


def summary(rollout: Rollout) -> str:
    """Markdown: what was tried, by whom, how it ended."""
    policy = "random actions" if rollout.policy_version < 0 else f"policy after {rollout.policy_version} updates"
    return (
        f"**{rollout.level_name}**: {rollout.outcome} after {rollout.num_steps} steps "
        f"({rollout.num_steps * rollout.step_seconds:.2f} s)\n\n{policy}, seed {rollout.seed}, "
        f"return {rollout.reward.sum():.3f}\n\nMake green touch blue, keep it off red. Darker shapes are fixed."
    )


def rollout_blueprint(rollout: Rollout) -> rrb.Blueprint:
    """The layout: the world on the left; summary and plots on the right; the time line below."""
    import rerun as rr
    import rerun.blueprint as rrb

    low_x, low_y, high_x, high_y = DEFAULT_VIEW
    size = (PIXELS_PER_METRE * (high_x - low_x), PIXELS_PER_METRE * (high_y - low_y))
    world = rrb.Spatial2DView(
        name="world",
        origin="camera",
        contents=["/camera", "/world/**"],
        background=[*BACKGROUND, 255],
        visual_bounds=rrb.VisualBounds2D(x_range=[0.0, size[0]], y_range=[0.0, size[1]]),
    )
    scene = rollout.level.scene
    plots: list[Any] = [rrb.TimeSeriesView(name="reward", origin="/", contents=["/reward", "/return"])]
    if _motors(rollout).size:
        plots.append(rrb.TimeSeriesView(name="motors, share of target speed", origin="motor"))
    if np.asarray(scene.thrusters.active).any():
        plots.append(rrb.TimeSeriesView(name="thrusters, share of power", origin="thruster"))
    plots.append(
        rrb.Tabs(
            rrb.TimeSeriesView(name="actions", origin="actions"),
            rrb.TextLogView(name="actions in words", origin="action_words"),
        )
    )
    text = rrb.TextDocumentView(name="rollout", origin="summary")
    right = rrb.Vertical(text, *plots, row_shares=[1.2] + [1.0] * len(plots))
    return rrb.Blueprint(
        rrb.Horizontal(world, right, column_shares=[1.5, 1.0]),
        rrb.BlueprintPanel(state=rr.blueprint.components.PanelState.Collapsed),
        rrb.SelectionPanel(state=rr.blueprint.components.PanelState.Collapsed),
        rrb.TimePanel(state=rr.blueprint.components.PanelState.Collapsed, timeline="time"),
    )


def _recording_id(rollout: Rollout) -> str:
    return f"{rollout.level_name} v{rollout.policy_version} seed {rollout.seed}"


def _motors(rollout: Rollout) -> np.ndarray:
    """Joints with a motor."""
    scene = rollout.level.scene
    return np.flatnonzero(np.asarray(scene.joints.active) & np.asarray(scene.joints.motor_on))


def _times(rollout: Rollout, rows: slice) -> list[Any]:
    """The two timelines of some of the states."""
    import rerun as rr

    steps = np.arange(rollout.num_steps + 1)[rows]
    return [rr.TimeColumn("step", sequence=steps), rr.TimeColumn("time", duration=rollout.seconds[rows])]


def _log_camera(stream: rr.RecordingStream) -> None:
    import rerun as rr

    low_x, low_y, high_x, high_y = DEFAULT_VIEW
    width, height = PIXELS_PER_METRE * (high_x - low_x), PIXELS_PER_METRE * (high_y - low_y)
    stream.log("camera", rr.Pinhole(focal_length=LENS, width=width, height=height), static=True)
    # Camera space: x right, y down, z away. At distance LENS one camera unit is one pixel.
    middle = np.array([(low_x + high_x) / 2, (low_y + high_y) / 2])
    scale = np.array([PIXELS_PER_METRE, -PIXELS_PER_METRE])
    stream.log(
        "world",
        rr.Transform3D(translation=[*(-middle * scale), LENS], mat3x3=np.diag([*scale, 1.0])),
        static=True,
    )


def _shape_path(i: int) -> str:
    return f"world/shape_{i:02d}"


def _at_depth(points: np.ndarray, nearer: float) -> np.ndarray:
    """[..., 2] m -> [..., 3], `nearer` camera units in front of the body's own plane."""
    depth = np.full((*points.shape[:-1], 1), -nearer)
    return np.concatenate([points, depth], axis=-1).astype(np.float32)


def _outline(primitive: Primitive) -> np.ndarray:
    """Corners [k, 2] m of a polygon or a disc, counter-clockwise."""
    if primitive.kind == POLYGON:
        return primitive.points
    turn = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
    return primitive.points[0] + primitive.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


class _Mesh(TypedDict):
    """Arguments of a Mesh3D."""

    vertex_positions: np.ndarray  # [k, 3]
    triangle_indices: np.ndarray  # [k - 2, 3]


def _filled(corners: np.ndarray, nearer: float) -> _Mesh:
    """Arguments of a Mesh3D that fills a convex polygon [k, 2]: a fan of triangles from its first corner."""
    second = np.arange(1, len(corners) - 1)
    fan = np.stack([np.zeros_like(second), second, second + 1], axis=-1)
    return _Mesh(vertex_positions=_at_depth(corners, nearer), triangle_indices=fan.astype(np.uint32))


def _colour(colour: Any) -> np.ndarray:
    return np.asarray(colour).astype(np.uint8)  # floats would be 0..1


def _log_body(stream: rr.RecordingStream, rollout: Rollout, i: int) -> None:
    """Logs the motion of a shape with all that lies in its frame. Fixed shapes lie behind, each in its plane."""
    import rerun as rr

    is_fixed = np.asarray(rollout.level.scene.shapes.inverse_mass)[i] == 0
    depth = (SHAPE_SPACING * rollout.num_shapes if is_fixed else 0.0) - SHAPE_SPACING * i
    translation = np.concatenate(
        [rollout.position[:, i], np.full((rollout.num_steps + 1, 1), depth, np.float32)], axis=-1
    )
    half = rollout.angle[:, i] / 2
    quaternion = np.stack([np.zeros_like(half), np.zeros_like(half), np.sin(half), np.cos(half)], axis=-1)
    if is_fixed:
        stream.log(_shape_path(i), rr.Transform3D(translation=translation[0], quaternion=quaternion[0]), static=True)
    else:
        columns = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        stream.send_columns(_shape_path(i), indexes=_times(rollout, slice(None)), columns=columns)


def _log_display(stream: rr.RecordingStream, rollout: Rollout, display: DisplayList) -> None:
    """Every primitive of the display list, what belongs to shapes in their planes, the rest in front of all."""
    num_of_part: dict[tuple[str, int], int] = {}
    for primitive in display.primitives:
        index = num_of_part.get(primitive.part, 0)
        num_of_part[primitive.part] = index + 1
        kind, number = primitive.part
        name = f"part_{index}" if kind == SHAPE else f"{kind}_{number}/part_{index}"
        path = f"{_shape_path(primitive.body)}/{name}"
        depth = PART_DEPTH * index + (0.0 if kind == SHAPE else MARK_DEPTH)
        if primitive.thruster is not None:
            _log_flame(stream, rollout, primitive, path, depth)
        elif primitive.kind in (POLYGON, DISC):
            _log_filled(stream, rollout, primitive, path, depth)
        elif primitive.kind == LINE and primitive.upright is None:
            _log_line(stream, primitive, path, depth)
        else:
            _log_moving_line(stream, rollout, primitive, f"world/{kind}_{number}/part_{index}", depth)


def _log_filled(stream: rr.RecordingStream, rollout: Rollout, primitive: Primitive, path: str, depth: float) -> None:
    """A polygon or a disc with its outline. That of a motor is coloured while it drives forward or backward."""
    import rerun as rr

    corners, fill = _outline(primitive), _colour(primitive.fill)
    if primitive.outline is not None:
        ring = _at_depth(np.concatenate([corners, corners[:1]]), depth + OUTLINE_DEPTH)
        lines = rr.LineStrips3D([ring], colors=[_colour(primitive.outline)], radii=rr.Radius.ui_points(1.0))
        stream.log(f"{path}/outline", lines, static=True)
    mesh = _filled(corners, depth)
    kind, number = primitive.part
    is_motor = kind == JOINT and primitive.outline is None and bool(rollout.level.scene.joints.motor_on[number])
    if not is_motor or rollout.num_steps == 0:
        stream.log(f"{path}/fill", rr.Mesh3D(**mesh, vertex_colors=np.tile(fill, (len(corners), 1))), static=True)
        return
    stream.log(f"{path}/fill", rr.Mesh3D(**mesh), static=True)
    drive = rollout.motor[:, number, None]
    colours = np.where(drive > 0, MOTOR_FORWARD, np.where(drive < 0, MOTOR_BACKWARD, HINGE)).astype(np.uint8)
    columns = rr.Mesh3D.columns(albedo_factor=colours)
    stream.send_columns(f"{path}/fill", indexes=_times(rollout, slice(None, -1)), columns=columns)


def _log_line(stream: rr.RecordingStream, primitive: Primitive, path: str, depth: float) -> None:
    import rerun as rr

    strip = _at_depth(primitive.points, depth + OUTLINE_DEPTH)
    radius = rr.Radius.ui_points(primitive.width / 2)
    stream.log(path, rr.LineStrips3D([strip], colors=[_colour(primitive.fill)], radii=radius), static=True)


def _log_moving_line(
    stream: rr.RecordingStream, rollout: Rollout, primitive: Primitive, path: str, depth: float
) -> None:
    """Logs a line that is rigid in the frame of no body: in the world, state by state."""
    import rerun as rr

    points_by_state = [world_points(primitive, *pose) for pose in zip(rollout.position, rollout.angle)]
    strips = [[_at_depth(points, depth)] for points in points_by_state if points is not None]
    style = rr.LineStrips3D.from_fields(
        colors=[_colour(primitive.fill)], radii=rr.Radius.ui_points(primitive.width / 2)
    )
    stream.log(path, style, static=True)
    columns = rr.LineStrips3D.columns(strips=[strip for (strip,) in strips])
    stream.send_columns(path, indexes=_times(rollout, slice(None)), columns=columns)


def _log_flame(stream: rr.RecordingStream, rollout: Rollout, primitive: Primitive, path: str, depth: float) -> None:
    """Logs the flame of a thruster while it fires, as long as its share of the power."""
    import rerun as rr

    if rollout.num_steps == 0:
        return
    fire = rollout.thruster[:, primitive.thruster]
    corners, start = _at_depth(primitive.points, depth), _at_depth(np.asarray(primitive.scale_from), depth)
    shown = start + (corners - start) * primitive.size * fire[fire > 0, None, None]
    columns = rr.Mesh3D.columns(
        vertex_positions=shown.reshape(-1, 3), vertex_colors=np.tile(_colour(primitive.fill), (3 * len(shown), 1))
    )
    lengths = np.where(fire > 0, 3, 0)  # no vertices: nothing drawn in that step
    stream.send_columns(path, indexes=_times(rollout, slice(None, -1)), columns=columns.partition(lengths=lengths))


def _log_plots(stream: rr.RecordingStream, rollout: Rollout) -> None:
    """Rewards stand at the state a step led to; commands at the state in which they were given."""
    import rerun as rr

    if rollout.num_steps == 0:
        return
    scene = rollout.level.scene
    after, before = slice(1, None), slice(None, -1)
    lines: list[tuple[str, str, np.ndarray, slice, Colour]] = [
        ("reward", "reward", rollout.reward, after, REWARD_COLOUR),
        ("return", "return so far", np.cumsum(rollout.reward), after, RETURN_COLOUR),
    ]
    for k in _motors(rollout):
        lines.append((f"motor/{k}", f"joint {k}", rollout.motor[:, k], before, MOTOR_PALETTE[k % len(MOTOR_PALETTE)]))
    for k in np.flatnonzero(np.asarray(scene.thrusters.active)):
        colour = THRUSTER_PALETTE[k % len(THRUSTER_PALETTE)]
        lines.append((f"thruster/{k}", f"thruster {k}", rollout.thruster[:, k], before, colour))
    for k, name in enumerate(rollout.names_of_actions):
        colour = ACTION_PALETTE[k % len(ACTION_PALETTE)]
        lines.append((f"actions/{k}", name.legend, rollout.actions[:, k], before, colour))
    for path, name, values, rows, colour in lines:
        style = rr.SeriesLines(
            names=[name],
            colors=[colour],
            interpolation_mode=rr.components.InterpolationMode.StepAfter if rows is before else None,
        )
        stream.log(path, style, static=True)
        stream.send_columns(path, indexes=_times(rollout, rows), columns=rr.Scalars.columns(scalars=values))
    _log_action_words(stream, rollout)


def _log_action_words(stream: rr.RecordingStream, rollout: Rollout) -> None:
    """The first action, and later each number of an action that is not that of the step before."""
    import rerun as rr

    changed = np.diff(rollout.actions, axis=0, prepend=np.nan) != 0
    steps = np.flatnonzero(changed.any(axis=1))
    names = rollout.names_of_actions
    words = [
        ", ".join(name.words(float(rollout.actions[step, k])) for k, name in enumerate(names) if changed[step, k])
        for step in steps
    ]
    indexes = [rr.TimeColumn("step", sequence=steps), rr.TimeColumn("time", duration=rollout.seconds[steps])]
    stream.send_columns("action_words", indexes=indexes, columns=rr.TextLog.columns(text=words))


if __name__ == "__main__":
    _send(pickle.load(sys.stdin.buffer), sys.argv[1], float(sys.argv[2]))
