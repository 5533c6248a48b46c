"""Motions with a formula: the scene, what the formula says, and how far a computed path is from it.

    @closed_form("free_fall", metric="height error / height fallen", seconds=1.5)
    def free_fall(b: SceneBuilder) -> Error: ...

Each function adds its bodies to a builder of CAPACITY and returns the error as a function of a `Path`. Errors have no
unit and no sign: each is divided by the size of what it measures, so that 0.01 is one per cent everywhere; angles are
in rad. A coefficient of friction mu is that between two shapes which both carry it (`with_plain_friction`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.path import Path, bounce_heights, crossings, vertex
from jax2d.fidelity.study_scene import Error, StudyScene
from jax2d.scene import Capacity
from jax2d.settings import Settings

# One capacity for all scenes, so that one compiled engine runs them all.
CAPACITY = Capacity(polygons=7, circles=3, joints=3, thrusters=2)
G = 9.81  # m/s^2
MOTOR_ACCELERATION = 900.0  # rad/s^2 of a motor of power 1, Settings.base_motor_power
MOTOR_SPEED = 6.0  # rad/s at motor_speed 1, Settings.base_motor_speed
THRUST = 10.0  # N of a thruster of power 1, Settings.base_thruster_power

CLOSED_FORMS: dict[str, StudyScene] = {}


def closed_form(
    name: str,
    *,
    metric: str,
    seconds: float,
    gravity: float = G,
    control: float = 0.0,
    needs_joint_force: bool = False,
) -> Callable[[Callable[[SceneBuilder], Error]], Callable[[SceneBuilder], Error]]:
    def register(build: Callable[[SceneBuilder], Error]) -> Callable[[SceneBuilder], Error]:
        CLOSED_FORMS[name] = StudyScene(
            name=name,
            metric=metric,
            seconds=seconds,
            capacity=CAPACITY,
            gravity=gravity,
            control=control,
            needs_joint_force=needs_joint_force,
            build=build,
        )
        return build

    return register


def with_plain_friction(settings: Settings) -> Settings:
    """The settings with friction in plain units: two shapes of coefficient mu rub with mu, whatever the mixing rule."""
    mixed = math.sqrt(2.0) if settings.friction_mixing == "root_sum_square" else 1.0  # of 1 and 1
    return settings.replace(base_friction=1.0 / mixed)


def _off(value: float, expected: float) -> float:
    return abs(value - expected) / abs(expected)


def _apart(value: np.ndarray, expected: tuple[float, ...] | list[float] | np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(value) - np.asarray(expected)))


# Free motion


@closed_form("free_fall", metric="height error / height fallen", seconds=1.5)
def free_fall(b: SceneBuilder) -> Error:
    ball = b.add_circle(radius=0.1)
    return lambda path: _off(path.position[-1, ball, 1], -G * path.times[-1] ** 2 / 2)


@closed_form("projectile", metric="distance from the parabola / distance flown", seconds=1.0)
def projectile(b: SceneBuilder) -> Error:
    ball = b.add_circle(radius=0.1, velocity=(3.0, 8.0))

    def error(path: Path) -> float:
        t = path.times[-1]
        expected = np.array([3.0 * t, 8.0 * t - G * t**2 / 2])
        return _apart(path.position[-1, ball], expected) / float(np.linalg.norm(expected))

    return error


@closed_form("thruster_push", metric="distance error / F t^2 / 2m", seconds=1.0, gravity=0.0, control=1.0)
def thruster_push(b: SceneBuilder) -> Error:
    box = b.add_box(width=1, height=0.5, density=2)  # 1 kg
    b.add_thruster(box, at=(0, 0), angle=0.0, power=0.3)
    return lambda path: (
        _apart(path.position[-1, box], (0.3 * THRUST * path.times[-1] ** 2 / 2, 0.0))
        / (0.3 * THRUST * path.times[-1] ** 2 / 2)
    )


@closed_form("thruster_couple", metric="angle error / F d t^2 / 2I", seconds=2.0, gravity=0.0, control=1.0)
def thruster_couple(b: SceneBuilder) -> Error:
    box = b.add_box(width=1, height=1)  # I = 1/6 kg m^2
    b.add_thruster(box, at=(0.5, 0), angle=math.pi / 2, power=0.01)
    b.add_thruster(box, at=(-0.5, 0), angle=-math.pi / 2, power=0.01)
    return lambda path: _off(path.angle[-1, box], 0.01 * THRUST * 1.0 * 6.0 * path.times[-1] ** 2 / 2)


@closed_form("spin", metric="angle error / angle turned", seconds=3.0, gravity=0.0)
def spin(b: SceneBuilder) -> Error:
    triangle = b.add_polygon([(0, 0), (1, 0), (0, 0.7)], angular_velocity=7.0, velocity=(1, 0))
    return lambda path: _off(path.angle[-1, triangle], 7.0 * path.times[-1])


# Friction


@closed_form("slide_to_stop", metric="distance error / v^2 / (2 mu g)", seconds=1.5)
def slide_to_stop(b: SceneBuilder) -> Error:
    speed, mu = 3.0, 0.3
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    box = b.add_box(width=0.6, height=0.2, position=(0, 0.1), velocity=(speed, 0), friction=mu)
    return lambda path: _off(path.position[-1, box, 0], speed**2 / (2 * mu * G))


def _slope(b: SceneBuilder, angle: float, mu: float) -> tuple[np.ndarray, np.ndarray]:
    """A plane that falls to the right through the origin: (downhill, normal) unit vectors."""
    normal = np.array([math.sin(angle), math.cos(angle)])
    b.add_box(width=20, height=1, angle=-angle, position=-0.5 * normal, fixed=True, friction=mu)
    return np.array([math.cos(angle), -math.sin(angle)]), normal


@closed_form("incline_slide", metric="distance error / g (sin a - mu cos a) t^2 / 2", seconds=1.0)
def incline_slide(b: SceneBuilder) -> Error:
    angle, mu = 0.5, 0.3
    downhill, normal = _slope(b, angle, mu)
    box = b.add_box(width=0.6, height=0.2, angle=-angle, position=0.1 * normal, friction=mu)
    acceleration = G * (math.sin(angle) - mu * math.cos(angle))
    return lambda path: _off(float(path.position[-1, box] @ downhill), acceleration * path.times[-1] ** 2 / 2)


@closed_form("incline_hold", metric="creep in 5 s / box width (mu > tan a)", seconds=5.0)
def incline_hold(b: SceneBuilder) -> Error:
    angle, mu, width = 0.25, 0.4, 0.6
    downhill, normal = _slope(b, angle, mu)
    box = b.add_box(width=width, height=0.2, angle=-angle, position=0.1 * normal, friction=mu)
    return lambda path: abs(float(path.position[-1, box] @ downhill)) / width


@closed_form("incline_roll", metric="distance error / (2/3 g sin a) t^2 / 2", seconds=1.0)
def incline_roll(b: SceneBuilder) -> Error:
    angle = 0.3
    downhill, normal = _slope(b, angle, 1.0)
    disc = b.add_circle(radius=0.2, position=0.2 * normal)
    return lambda path: _off(
        float(path.position[-1, disc] @ downhill), 2 / 3 * G * math.sin(angle) * path.times[-1] ** 2 / 2
    )


@closed_form("incline_slip", metric="larger of distance and angle error (mu < tan(a)/3)", seconds=1.0)
def incline_slip(b: SceneBuilder) -> Error:
    angle, mu, radius = 0.5, 0.1, 0.2
    downhill, normal = _slope(b, angle, mu)
    disc = b.add_circle(radius=radius, position=radius * normal, friction=mu)

    def error(path: Path) -> float:
        half_t2 = path.times[-1] ** 2 / 2
        distance = G * (math.sin(angle) - mu * math.cos(angle)) * half_t2
        turned = -2 * mu * G * math.cos(angle) / radius * half_t2
        return max(_off(float(path.position[-1, disc] @ downhill), distance), _off(path.angle[-1, disc], turned))

    return error


@closed_form("spin_to_roll", metric="speed error / (w0 r / 3)", seconds=1.0)
def spin_to_roll(b: SceneBuilder) -> Error:
    radius, mu, spin_before = 0.2, 0.5, 20.0
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    disc = b.add_circle(radius=radius, position=(0, radius), friction=mu, angular_velocity=-spin_before)
    return lambda path: _off(path.velocity[-1, disc, 0], spin_before * radius / 3)


@closed_form("slide_to_roll", metric="distance error / distance (v0 -> 2/3 v0)", seconds=1.0)
def slide_to_roll(b: SceneBuilder) -> Error:
    radius, mu, speed = 0.2, 0.5, 3.0
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    disc = b.add_circle(radius=radius, position=(0, radius), friction=mu, velocity=(speed, 0))
    slipping = speed / (3 * mu * G)  # s
    slipped = speed * slipping - mu * G * slipping**2 / 2
    return lambda path: _off(path.position[-1, disc, 0], slipped + 2 / 3 * speed * (path.times[-1] - slipping))


# Impacts


def _bounce(b: SceneBuilder, restitution: float, height: float = 1.0) -> int:
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=restitution)
    return b.add_circle(radius=0.1, position=(0, height + 0.1), restitution=restitution)


@closed_form("bounce_e0.8", metric="largest error of three heights / e^2n h0", seconds=2.1)
def bounce(b: SceneBuilder) -> Error:
    e = 0.8
    ball = _bounce(b, e)

    def error(path: Path) -> float:
        heights = [*bounce_heights(path.position[:, ball, 1] - 0.1, path.velocity[:, ball, 1]), 0.0, 0.0, 0.0]
        return max(_off(heights[n], e ** (2 * n + 2)) for n in range(3))

    return error


@closed_form("bounce_e0.5", metric="height error / e^2 h0", seconds=1.0)
def bounce_half(b: SceneBuilder) -> Error:
    ball = _bounce(b, 0.5)

    def error(path: Path) -> float:
        heights = [*bounce_heights(path.position[:, ball, 1] - 0.1, path.velocity[:, ball, 1]), 0.0]
        return _off(heights[0], 0.25)

    return error


@closed_form("bounce_elastic", metric="largest height error in 10 s / h0 (e = 1)", seconds=10.0)
def bounce_elastic(b: SceneBuilder) -> Error:
    ball = _bounce(b, 1.0)

    def error(path: Path) -> float:
        heights = bounce_heights(path.position[:, ball, 1] - 0.1, path.velocity[:, ball, 1])
        return max((abs(height - 1.0) for height in heights), default=1.0)

    return error


@closed_form("flat_bounce", metric="height error / e^2 h0, plus turn / 1 rad (a box that lands flat)", seconds=0.9)
def flat_bounce(b: SceneBuilder) -> Error:
    e, height = 0.5, 1.0
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=e)
    box = b.add_box(width=0.4, height=0.2, position=(0, height + 0.1), restitution=e)

    def error(path: Path) -> float:
        after = path.times > 0.5  # it falls until 0.45 s and is down again at 0.9 s
        height_after = path.position[after, box, 1] - 0.1
        top = int(np.argmax(height_after))
        return _off(vertex(height_after, top), e**2 * height) + abs(path.angle[after, box][top])

    return error


@closed_form("welded_bounce", metric="height error / e^2 h0 (a disc with a box welded on it)", seconds=0.9)
def welded_bounce(b: SceneBuilder) -> Error:
    e, height, radius = 0.5, 1.0, 0.1
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=e)
    disc = b.add_circle(radius=radius, position=(0, height + radius), restitution=e)
    box = b.add_box(width=0.4, height=0.2, position=(0, height + 3 * radius), restitution=e)
    b.add_fixed_joint(disc, box, at=(0, height + 2 * radius))

    def error(path: Path) -> float:
        # It falls until 0.45 s and is down again at 0.9 s.
        after = path.position[path.times > 0.5, disc, 1] - radius
        return _off(vertex(after, int(np.argmax(after))), e**2 * height)

    return error


@closed_form("collision", metric="largest position error / relative distance travelled", seconds=0.6, gravity=0.0)
def collision(b: SceneBuilder) -> Error:
    e, radius, mass_ratio = 0.5, 0.2, 3.0
    light = b.add_circle(radius=radius, position=(-0.5, 0), velocity=(2, 0), restitution=e, friction=0)
    heavy = b.add_circle(
        radius=radius, position=(0.5, 0), velocity=(-1, 0), density=mass_ratio, restitution=e, friction=0
    )
    impact = (1.0 - 2 * radius) / 3.0  # s: the gap over the approach speed
    common = (2.0 - mass_ratio) / (1 + mass_ratio)
    light_after = common - mass_ratio * e * 3.0 / (1 + mass_ratio)
    heavy_after = common + e * 3.0 / (1 + mass_ratio)

    def error(path: Path) -> float:
        t = path.times[-1]
        at_light = -0.5 + 2.0 * impact + light_after * (t - impact)
        at_heavy = 0.5 - 1.0 * impact + heavy_after * (t - impact)
        return max(
            _apart(path.position[-1, light], (at_light, 0.0)), _apart(path.position[-1, heavy], (at_heavy, 0.0))
        ) / (3.0 * t)

    return error


@closed_form("collision_off_centre", metric="largest velocity error / approach speed", seconds=0.8, gravity=0.0)
def collision_off_centre(b: SceneBuilder) -> Error:
    e, radius, speed = 0.5, 0.2, 2.0
    mover = b.add_circle(radius=radius, position=(-0.8, 0), velocity=(speed, 0), restitution=e, friction=0)
    rester = b.add_circle(radius=radius, position=(0, radius), restitution=e, friction=0)
    normal = np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])  # offset r between centres 2 r apart
    given = (1 + e) / 2 * speed * normal[0] * normal

    def error(path: Path) -> float:
        stayed = _apart(path.velocity[-1, mover], np.array([speed, 0.0]) - given)
        return max(stayed, _apart(path.velocity[-1, rester], given)) / speed

    return error


@closed_form("bounce_oblique", metric="error of (vx, vy, w r) / speed", seconds=0.6, gravity=0.0)
def bounce_oblique(b: SceneBuilder) -> Error:
    e, mu, radius = 0.8, 0.2, 0.2
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, restitution=e, friction=mu)
    disc = b.add_circle(radius=radius, position=(0, radius + 0.5), velocity=(3, -2), restitution=e, friction=mu)
    rubbed = mu * (1 + e) * 2.0  # m/s; the contact slides throughout since 3 x this < 3 m/s

    def error(path: Path) -> float:
        after = np.array([*path.velocity[-1, disc], path.angular_velocity[-1, disc] * radius])
        return _apart(after, (3.0 - rubbed, e * 2.0, -2 * rubbed)) / math.hypot(3, 2)

    return error


# Pendulums and chains


def _agm(a: float, b: float) -> float:
    while abs(a - b) > 1e-14:
        a, b = (a + b) / 2, math.sqrt(a * b)
    return a


def _hang(b: SceneBuilder, swing: float, length: float = 1.0, radius: float = 0.2) -> int:
    """A disc on a fixed pivot at the origin, `swing` rad from the vertical."""
    pivot = b.add_circle(radius=0.05, fixed=True)
    bob = b.add_circle(radius=radius, position=(length * math.sin(swing), -length * math.cos(swing)))
    b.add_revolute_joint(pivot, bob, at=(0, 0))
    return bob


def _pendulum_period(swing: float, length: float = 1.0, radius: float = 0.2) -> float:
    inertia_over_mass = length**2 + radius**2 / 2
    return 2 * math.pi * math.sqrt(inertia_over_mass / (G * length)) / _agm(1.0, math.cos(swing / 2))


def _pendulum(swing: float) -> Callable[[SceneBuilder], Error]:
    period = _pendulum_period(swing)

    def build(b: SceneBuilder) -> Error:
        bob = _hang(b, swing)

        def error(path: Path) -> float:
            # From rest: turns back after half a period, is at rest again after a whole one. The start is no crossing.
            turns = crossings(path.angular_velocity[1:, bob], path.dt) + path.dt
            return _off(turns[1], period) if len(turns) > 1 else 1.0

        return error

    return build


for _swing in (0.2, 1.0, 2.0, 2.8):
    closed_form(
        f"pendulum_{_swing:g}", metric="period error / period", seconds=math.ceil(1.2 * _pendulum_period(_swing))
    )(_pendulum(_swing))


@closed_form("pendulum_energy", metric="energy change in 10 s / swing energy", seconds=10.0)
def pendulum_energy(b: SceneBuilder) -> Error:
    swing = 1.0
    _hang(b, swing)
    swing_energy = math.pi * 0.2**2 * G * (1 - math.cos(swing))

    def error(path: Path) -> float:
        energy = path.energy()
        # Over the last two periods, so that what swings to and fro within one does not count as drift.
        tail = max(1, round(2 * _pendulum_period(swing) / path.dt))
        return abs(float(energy[-tail:].mean() - energy[0])) / swing_energy

    return error


@closed_form("double_pendulum", metric="largest energy change in 3 s / energy above rest", seconds=3.0)
def double_pendulum(b: SceneBuilder) -> Error:
    arm, swing, radius = 0.5, 2.0, 0.1
    knee = np.array([arm * math.sin(swing), -arm * math.cos(swing)])
    pivot = b.add_circle(radius=0.05, fixed=True)
    upper = b.add_circle(radius=radius, position=knee)
    lower = b.add_circle(radius=radius, position=2 * knee)
    b.add_revolute_joint(pivot, upper, at=(0, 0))
    b.add_revolute_joint(upper, lower, at=knee)
    b.keep_apart(pivot, lower)
    above_rest = math.pi * radius**2 * G * 3 * arm * (1 - math.cos(swing))

    def error(path: Path) -> float:
        energy = path.energy()
        return float(np.abs(energy - energy[0]).max()) / above_rest

    return error


@closed_form("jointed_pair", metric="larger of change in P / P and L / L in 10 s", seconds=10.0, gravity=0.0)
def jointed_pair(b: SceneBuilder) -> Error:
    left = b.add_box(width=1, height=0.4, velocity=(0.5, 1.0), angular_velocity=2.0)
    # Compatible with the joint: at the start the anchors of both move alike.
    right = b.add_box(width=0.8, height=0.3, position=(0.9, 0), velocity=(0.5, 2.0))
    b.add_revolute_joint(left, right, at=(0.5, 0))

    def error(path: Path) -> float:
        linear, angular = path.momentum(), path.angular_momentum()
        return max(_apart(linear[-1], linear[0]) / float(np.linalg.norm(linear[0])), _off(angular[-1], angular[0]))

    return error


def _chain(b: SceneBuilder, end_density: float) -> float:
    """Three links of 0.5 m hanging from a pivot at the origin; the last of another density. Returns the weight in N."""
    length, width = 0.5, 0.1
    previous = b.add_circle(radius=0.05, fixed=True)
    links = [
        b.add_box(width=width, height=length, position=(0, -length * (i + 0.5)), density=density)
        for i, density in enumerate((1.0, 1.0, end_density))
    ]
    for i, link in enumerate(links):
        b.add_revolute_joint(previous, link, at=(0, -length * i))
        previous = link
    b.keep_apart(links[0], links[2])
    return length * width * (2.0 + end_density) * G


@closed_form("chain_gap", metric="widest joint gap at rest / link length", seconds=5.0)
def chain_gap(b: SceneBuilder) -> Error:
    _chain(b, 1.0)
    return lambda path: float(path.joint_gaps()[-1].max()) / 0.5


@closed_form("heavy_chain_gap", metric="widest joint gap at rest / link length (last link 50 x)", seconds=5.0)
def heavy_chain_gap(b: SceneBuilder) -> Error:
    _chain(b, 50.0)
    return lambda path: float(path.joint_gaps()[-1].max()) / 0.5


@closed_form("chain_force", metric="force in the top joint - weight / weight", seconds=5.0, needs_joint_force=True)
def chain_force(b: SceneBuilder) -> Error:
    weight = _chain(b, 1.0)

    def error(path: Path) -> float:
        assert path.joint_force is not None
        return _off(float(np.linalg.norm(path.joint_force[-1, 0])), weight)

    return error


@closed_form("lever_balance", metric="tilt after 3 s, rad (m1 d1 = m2 d2)", seconds=3.0)
def lever_balance(b: SceneBuilder) -> Error:
    pivot = b.add_circle(radius=0.05, fixed=True)
    beam = b.add_box(width=3, height=0.1)
    near = b.add_box(width=0.4, height=0.4, position=(-0.6, 0), density=2)
    far = b.add_box(width=0.4, height=0.4, position=(1.2, 0), density=1)
    b.add_revolute_joint(pivot, beam, at=(0, 0))
    b.add_fixed_joint(beam, near, at=(-0.6, 0))
    b.add_fixed_joint(beam, far, at=(1.2, 0))
    for weight in (near, far):
        b.keep_apart(pivot, weight)
    return lambda path: abs(float(path.angle[-1, beam]))


# Motors


@closed_form("motor_run_up", metric="angle error / angle turned", seconds=1.5, gravity=0.0, control=1.0)
def motor_run_up(b: SceneBuilder) -> Error:
    power, speed = 0.02, 2.0
    base = b.add_box(width=1, height=1, fixed=True)
    wheel = b.add_circle(radius=0.3)
    b.add_revolute_joint(base, wheel, at=(0, 0), motor_speed=speed, motor_power=power)
    acceleration, target = power * MOTOR_ACCELERATION, speed * MOTOR_SPEED
    reached = target / acceleration  # s
    return lambda path: _off(path.angle[-1, wheel], target * (path.times[-1] - reached / 2))


ARM_M, ARM_WIDTH_M = 1.0, 0.2
ARM_KG = ARM_M * ARM_WIDTH_M
ARM_INERTIA = ARM_KG * (ARM_M**2 + ARM_WIDTH_M**2) / 12  # kg m^2 about its centre


def _arm(b: SceneBuilder, angle: float, torque: float) -> int:
    """A rod hanging `angle` rad from the vertical on a motor of that torque (N m) at the origin."""
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    position = (ARM_M / 2 * math.sin(angle), -ARM_M / 2 * math.cos(angle))
    arm = b.add_box(width=ARM_WIDTH_M, height=ARM_M, position=position, angle=angle)
    power = torque / (MOTOR_ACCELERATION * ARM_INERTIA)
    b.add_revolute_joint(base, arm, at=(0, 0), motor_speed=2.0, motor_power=power)
    return arm


@closed_form("motor_stall", metric="angle from m g l sin th = torque after 2 s, rad", seconds=2.0, control=1.0)
def motor_stall(b: SceneBuilder) -> Error:
    angle = 0.8
    arm = _arm(b, angle, ARM_KG * G * ARM_M / 2 * math.sin(angle))
    return lambda path: abs(float(path.angle[-1, arm]) - angle)


@closed_form(
    "motor_lift", metric="error of the highest angle / angle (work = m g l (1 - cos th))", seconds=2.0, control=1.0
)
def motor_lift(b: SceneBuilder) -> Error:
    highest = 1.2
    arm = _arm(b, 0.0, ARM_KG * G * ARM_M / 2 * (1 - math.cos(highest)) / highest)

    def error(path: Path) -> float:
        angle = path.angle[:, arm]
        return _off(vertex(angle, int(np.argmax(angle))), highest)

    return error


# Rest


@closed_form("stack_rest", metric="farthest box from where it stood after 5 s / box width", seconds=5.0)
def stack_rest(b: SceneBuilder) -> Error:
    width = 0.5
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    boxes = [b.add_box(width=width, height=width, position=(0, width * (i + 0.5))) for i in range(5)]
    return lambda path: max(_apart(path.position[-1, i], path.position[0, i]) for i in boxes) / width


@closed_form(
    "newtons_cradle", metric="highest angle of the last ball / first - 1 (approximate: gaps of 2 mm)", seconds=1.2
)
def newtons_cradle(b: SceneBuilder) -> Error:
    radius, gap, length, swing = 0.1, 0.002, 1.0, 0.5
    ceiling = b.add_box(width=3, height=0.2, position=(0, 0.1), fixed=True)
    balls = []
    for i, angle in enumerate((-swing, 0.0, 0.0)):
        x = i * (2 * radius + gap)
        at = (x + length * math.sin(angle), -length * math.cos(angle))
        ball = b.add_circle(radius=radius, position=at, restitution=1.0, friction=0.0)
        b.add_revolute_joint(ceiling, ball, at=(x, 0))
        balls.append(ball)

    def error(path: Path) -> float:
        angle = path.angle[:, balls[-1]]
        return _off(vertex(angle, int(np.argmax(angle))), swing)

    return error
