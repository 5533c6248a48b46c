"""Pixel observations against the picture that `jax2d.draw` paints of the same world by code of its own."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.draw import draw
from jax2d.palette import BACKGROUND, ROLE_PALETTE
from jax2d.scene import JointKind
from kinetix_dist.env import device_memory
from kinetix_dist.env.device_memory import DeviceMemoryError
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.env.observations.pixels import FAR_M, PIXELS, PixelStatic, picture, static_picture
from kinetix_dist.level.level import Level, Role
from kinetix_dist.level.sets import load_level_set
from tests.env.worlds import BOX, DISC_1, DISC_2, MOTOR_JOINT, THRUSTER, batch, small_level
from tests.helpers import present

PICTURES = OBSERVATIONS["pixels"]


@pytest.fixture(scope="module")
def levels() -> Level:
    """The designed levels of size S, and hand-made ones with each kind of joint, a thruster and fixed shapes."""
    designed, _ = load_level_set("levels/s")
    slides = MOTOR_JOINT | {"joints.kind": int(JointKind.PRISMATIC), "joints.axis_angle": 0.4}
    limits = {"joints.has_limits": True, "joints.lower_limit": -0.3, "joints.upper_limit": 0.8, "motor_colour": 3}
    made = [
        small_level(joint=MOTOR_JOINT, thruster=THRUSTER, disc_2=(4.2, 4.2), fixed=(DISC_2,)),
        small_level(joint=MOTOR_JOINT | {"joints.kind": int(JointKind.FIXED)}, thruster=THRUSTER),
        small_level(joint=slides, disc_2=(2.0, 3.0), roles={BOX: Role.RED, DISC_1: Role.GREEN, DISC_2: Role.BLUE}),
        small_level(joint=slides | limits, thruster=THRUSTER | {"thruster_colour": 0}, fixed=(BOX,)),
        small_level(joint=MOTOR_JOINT | {"joints.motor_on": False}, fixed=(BOX, DISC_1)),
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts), designed, jax.tree.map(np.asarray, batch(*made)))


def moved(levels: Level) -> np.ndarray:
    """Poses [W, n, 3] in which everything that can move is elsewhere and turned."""
    poses = np.concatenate([levels.position, levels.angle[..., None]], axis=-1)
    change = np.random.default_rng(0).uniform(-0.5, 0.5, poses.shape) * [1, 1, 6]
    return poses + change * (levels.scene.shapes.inverse_mass > 0)[..., None]


def drawn(levels: Level, poses: np.ndarray, world: int) -> np.ndarray:
    """[500, 500, 3], at four times the resolution."""
    level = jax.tree.map(lambda x: np.asarray(x)[world], levels)
    return draw(
        level.scene,
        SimpleNamespace(position=poses[world, :, :2], angle=poses[world, :, 2]),
        level.shape_role,
        motor_colours=level.motor_colour,
        thruster_colours=level.thruster_colour,
        view=(0, 0, 5, 5),
    )


@pytest.fixture(scope="module")
def static(levels: Level) -> PixelStatic:
    return static_picture(levels)


@pytest.fixture(scope="module")
def pictures(levels: Level, static: PixelStatic) -> list[tuple[np.ndarray, np.ndarray]]:
    """(ours [125, 125, 3], drawn [500, 500, 3]) of every level, as it starts and with everything moved."""
    start = np.concatenate([levels.position, levels.angle[..., None]], axis=-1)
    pairs = []
    for poses in (start, moved(levels)):
        ours = np.asarray(picture(static, jnp.asarray(poses, jnp.float32)))
        assert ours.dtype == np.uint8 and ours.shape == (len(poses), PIXELS, PIXELS, 3)
        pairs += [(ours[world], drawn(levels, poses, world)) for world in range(len(poses))]
    return pairs


def blocks(image: np.ndarray) -> np.ndarray:
    """[500, 500, 3] as [125, 125, 16, 3]."""
    side = PIXELS
    return image.reshape(side, 4, side, 4, 3).transpose(0, 2, 1, 3, 4).reshape(side, side, 16, 3)


def test_pixels_within_one_colour_have_that_colour(pictures):
    """Pixels where the drawing has one colour there and all around; one step of 256 for rounding."""
    for ours, image in pictures:
        parts = blocks(image)
        is_plain = (parts.max(axis=2) == parts.min(axis=2)).all(axis=-1)
        rows, columns = np.nonzero(is_plain)
        inside = (rows > 0) & (rows < PIXELS - 1) & (columns > 0) & (columns < PIXELS - 1)
        rows, columns = rows[inside], columns[inside]
        around = [is_plain[rows + i, columns + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        rows, columns = rows[np.all(around, axis=0)], columns[np.all(around, axis=0)]
        assert len(rows) > 0.7 * PIXELS**2
        difference = ours[rows, columns].astype(int) - parts[rows, columns, 0]
        assert np.abs(difference).max() <= 1


def test_edges_are_those_of_the_drawing_downscaled(pictures):
    """Corners and things of a pixel or less differ a little: cover is estimated from one distance."""
    for ours, image in pictures:
        difference = np.abs(ours - blocks(image).mean(axis=2)).max(axis=-1)
        assert difference.mean() < 0.15 and (difference > 24).mean() < 1e-3


def test_roles_cover_as_much_of_ours_as_of_the_drawing(pictures):
    def area(image: np.ndarray, colour: tuple[int, int, int]) -> float:
        return (np.abs(image.astype(int) - colour).max(axis=-1) <= 2).mean()

    for ours, image in pictures:
        for colour in (*ROLE_PALETTE, BACKGROUND):
            assert area(ours, colour) == pytest.approx(area(image, colour), abs=0.01)  # half a pixel along edges


def test_a_level_may_be_seen_at_many_times_at_once(levels: Level, static: PixelStatic):
    poses = jnp.asarray(moved(levels), jnp.float32)
    twice = np.asarray(picture(static, jnp.stack([poses, poses + 0.1])))
    np.testing.assert_array_equal(twice[0], picture(static, poses))
    np.testing.assert_array_equal(twice[1], picture(static, poses + 0.1))


def test_what_has_diverged_is_not_in_the_picture(levels: Level, static: PixelStatic):
    poses = moved(levels).astype(np.float32)
    gone = poses.copy()
    gone[:, 4:] = FAR_M
    expected = picture(static, jnp.asarray(gone))
    for number in (np.nan, np.inf, 1e30):
        poses[:, 4:] = number
        np.testing.assert_array_equal(picture(static, jnp.asarray(poses)), expected)


def test_the_environment_gives_pictures_of_where_bodies_are(levels: Level):
    env = Environment(EnvConfig(observation="pixels"))
    prepared = env.prepare(levels)
    state, obs = env.reset(prepared)
    assert obs.nbytes == len(obs) * 7 * 12  # what a rollout stores
    for _ in range(5):
        state, obs, *_ = env.step(prepared, state, env.action_space.sample(jax.random.key(0), len(obs)))
    position, angle, *_ = env.engine.bodies(state.packed_state)
    seen = np.asarray(env.observe(prepared, obs))
    poses = np.concatenate([position, angle[..., None]], axis=-1)
    for world in range(0, len(obs), 4):
        assert np.abs(seen[world] - blocks(drawn(levels, poses, world)).mean(axis=2)).mean() < 0.15


def test_working_memory_is_not_underestimated(levels: Level, static: PixelStatic):
    analysis = present(picture.lower(static, jnp.asarray(moved(levels), jnp.float32)).compile().memory_analysis())
    used = analysis.temp_size_in_bytes + analysis.output_size_in_bytes + analysis.argument_size_in_bytes
    assert 0.5 * PICTURES.working_bytes < used / len(levels.angle) <= PICTURES.working_bytes


def test_more_worlds_than_pictures_fit_are_refused_with_how_many_do(levels: Level, monkeypatch):
    monkeypatch.setattr(device_memory, "device_bytes", lambda: 2 * PICTURES.working_bytes)
    env = Environment(EnvConfig(observation="pixels"))
    with pytest.raises(DeviceMemoryError, match=r"worlds: 3 take 0.0 GiB at once.*at most 2 fit; play fewer worlds"):
        env.prepare(jax.tree.map(lambda x: x[:3], levels))
