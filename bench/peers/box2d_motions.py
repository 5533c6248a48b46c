"""Box2D 2.3 (its Python package, in its own environment) over the scenes of `python -m jax2d.fidelity`.

    python box2d_motions.py --check            prints the version
    python box2d_motions.py IN.npz OUT.npz     scenes as jax2d/fidelity/peers.py writes them, states as it reads them

then a request a line on standard input, {"setting": k, "scene": i}, and what one timed run of it cost on standard
output, {"ok": true, "us": us per simulated second}; a failure answers {"ok": false, "error": one line}.

One world at a time, stepped from Python; the time of a run is that of all its steps, the calls included. This file
uses nothing of the project.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import Box2D
import numpy as np

FIXED = 1  # `JointKind` of a weld


class AllowedPairs(Box2D.b2ContactFilter):
    """Who may touch whom, by the index kept with each body."""

    def __init__(self, can_touch: np.ndarray) -> None:
        super().__init__()
        self.can_touch = can_touch

    def ShouldCollide(self, a: Any, b: Any) -> bool:
        return bool(self.can_touch[a.body.userData, b.body.userData])


class World:
    """One world of the request."""

    def __init__(self, request: dict[str, np.ndarray], i: int, constants: dict[str, float]) -> None:
        scene = {name.removeprefix("scene."): value[i] for name, value in request.items() if name.startswith("scene.")}
        self.scene = scene
        self.num_shapes = len(scene["shapes.active"])
        control = float(request["control"][i])
        self.filter = AllowedPairs(scene["shapes.can_touch"])
        self.world = Box2D.b2World(gravity=tuple(map(float, scene["gravity"])), contactFilter=self.filter)
        self.world.allowSleeping = False  # a sleeping body costs nothing and errs by nothing
        start = (request[name][i] for name in ("position", "angle", "velocity", "angular_velocity"))
        self.bodies = [self._body(shape, *values) for shape, *values in zip(range(self.num_shapes), *start)]
        self.joints = [self._joint(j, control, constants) for j in np.flatnonzero(scene["joints.active"])]
        self.thrusts = [
            (
                self.bodies[int(scene["thrusters.body"][t])],
                tuple(map(float, scene["thrusters.position"][t])),
                float(scene["thrusters.angle"][t]),
                control * float(scene["thrusters.power"][t]) * constants["thruster_power"],
            )
            for t in np.flatnonzero(scene["thrusters.active"])
        ]

    def _body(self, shape: int, position: Any, angle: Any, velocity: Any, angular_velocity: Any) -> Any:
        scene, polygons = self.scene, len(self.scene["shapes.num_vertices"])
        if not scene["shapes.active"][shape]:
            return None
        if shape < polygons:
            corners = scene["shapes.vertices"][shape][: scene["shapes.num_vertices"][shape]]
            geometry = Box2D.b2PolygonShape(vertices=[tuple(map(float, corner)) for corner in corners])
        else:
            geometry = Box2D.b2CircleShape(radius=float(scene["shapes.radius"][shape - polygons]))
        movable = scene["shapes.inverse_mass"][shape] > 0
        body = (self.world.CreateDynamicBody if movable else self.world.CreateStaticBody)(
            position=tuple(map(float, position)), angle=float(angle), userData=shape
        )
        body.CreateFixture(
            shape=geometry,
            density=float(scene["shapes.density"][shape]),
            friction=float(scene["shapes.friction"][shape]),
            restitution=float(scene["shapes.restitution"][shape]),
        )
        if movable:
            body.linearVelocity = tuple(map(float, velocity))
            body.angularVelocity = float(angular_velocity)
        return body

    def _joint(self, j: int, control: float, constants: dict[str, float]) -> Any:
        scene = self.scene
        a, b = int(scene["joints.a"][j]), int(scene["joints.b"][j])
        common = {
            "bodyA": self.bodies[a],
            "bodyB": self.bodies[b],
            "localAnchorA": tuple(map(float, scene["joints.anchor_a"][j])),
            "localAnchorB": tuple(map(float, scene["joints.anchor_b"][j])),
            "referenceAngle": float(scene["joints.rest_angle"][j]),
            "collideConnected": bool(scene["shapes.can_touch"][a, b]),
        }
        if scene["joints.kind"][j] == FIXED:
            return self.world.CreateWeldJoint(**common)
        inertia = 1.0 / float(scene["shapes.inverse_inertia"][a] + scene["shapes.inverse_inertia"][b])
        return self.world.CreateRevoluteJoint(
            **common,
            enableMotor=bool(scene["joints.motor_on"][j]) and control != 0.0,
            motorSpeed=control * float(scene["joints.motor_speed"][j]) * constants["motor_speed"],
            maxMotorTorque=float(scene["joints.motor_power"][j]) * constants["motor_acceleration"] * inertia,
            enableLimit=bool(scene["joints.has_limits"][j]),
            lowerAngle=float(scene["joints.lower_limit"][j]),
            upperAngle=float(scene["joints.upper_limit"][j]),
        )

    def step(self, dt: float, velocity_iterations: int, position_iterations: int) -> None:
        for body, local, angle, force in self.thrusts:
            turned = body.angle + angle
            body.ApplyForce((force * np.cos(turned), force * np.sin(turned)), body.GetWorldPoint(local), True)
        self.world.Step(dt, velocity_iterations, position_iterations)

    def state(self) -> np.ndarray:
        """[n, 6]: position, angle, velocity, angular velocity; zero for inactive shapes."""
        return np.array(
            [
                (*body.worldCenter, body.angle, *body.linearVelocity, body.angularVelocity) if body else (0.0,) * 6
                for body in self.bodies
            ]
        )


def main() -> int:
    if "--check" in sys.argv:
        print(json.dumps({"version": Box2D.__version__}))
        return 0
    request = dict(np.load(sys.argv[1]))
    query = json.loads(str(request["query"]))
    answer: dict[str, np.ndarray] = {}
    for k, setting in enumerate(query["settings"]):
        dt = setting["dt"]
        arguments = (dt, setting["velocity_iterations"], setting["position_iterations"])
        for i, seconds in enumerate(request["seconds"]):
            world = World(request, i, query["constants"])
            states = [world.state()]
            for _ in range(round(float(seconds) / dt)):
                world.step(*arguments)
                states.append(world.state())
            answer[f"states.{k}.{i}"] = np.array(states)
    np.savez(sys.argv[2], device=np.array("cpu"), version=np.array(Box2D.__version__), **answer)
    print(json.dumps({"ok": True}), flush=True)
    for line in sys.stdin:
        wanted = json.loads(line)
        setting, i = query["settings"][wanted["setting"]], wanted["scene"]
        print(json.dumps({"ok": True, "us": cost(request, i, query["constants"], **setting)}), flush=True)
    return 0


def cost(
    request: dict[str, np.ndarray],
    i: int,
    constants: dict[str, float],
    *,
    dt: float,
    velocity_iterations: int,
    position_iterations: int,
) -> float:
    """us per simulated second of one run of world i."""
    steps = round(float(request["seconds"][i]) / dt)
    world = World(request, i, constants)
    started = time.perf_counter()
    for _ in range(steps):
        world.step(dt, velocity_iterations, position_iterations)
    return 1e6 * (time.perf_counter() - started) / (steps * dt)


if __name__ == "__main__":
    sys.exit(main())
