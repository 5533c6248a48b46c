"""jax2d: simulates thousands to a million small 2D rigid-body worlds at once, on CPU and CUDA, from JAX."""

from jax2d.builder import BuiltWorld, SceneBuilder, SceneError, SceneFullError
from jax2d.contact_report import ContactReport
from jax2d.effects import EFFECTS, Effects, EffectTable, MissingEffectError, called_for, effects_of
from jax2d.engine import Engine
from jax2d.queries import RayHits, cast_rays, point_in_shapes
from jax2d.recorder import record
from jax2d.scene import (
    Capacity,
    Controls,
    JointDrive,
    JointKind,
    Joints,
    Scene,
    Shapes,
    Springs,
    State,
    Thrusters,
    Touching,
    index_worlds,
    stack_worlds,
    touch_matrix,
)
from jax2d.settings import PRESETS, Settings, preset
from jax2d.shapes import circle_mass_properties, polygon_mass_properties
from jax2d.trajectory import Trajectory
from jax2d.world_order import STRUCTURE, WorldOrder, order_by_structure, structure_of

__all__ = [
    "EFFECTS",
    "PRESETS",
    "STRUCTURE",
    "BuiltWorld",
    "Capacity",
    "ContactReport",
    "Controls",
    "EffectTable",
    "Effects",
    "Engine",
    "JointDrive",
    "JointKind",
    "Joints",
    "MissingEffectError",
    "RayHits",
    "Scene",
    "SceneBuilder",
    "SceneError",
    "SceneFullError",
    "Settings",
    "Shapes",
    "Springs",
    "State",
    "Thrusters",
    "Touching",
    "Trajectory",
    "WorldOrder",
    "called_for",
    "cast_rays",
    "circle_mass_properties",
    "effects_of",
    "index_worlds",
    "order_by_structure",
    "point_in_shapes",
    "polygon_mass_properties",
    "preset",
    "record",
    "stack_worlds",
    "structure_of",
    "touch_matrix",
]
