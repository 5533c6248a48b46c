"""Memory of a world, as computed from the layout and as it is."""

from __future__ import annotations

import jax
import pytest

from jax2d import Capacity, Effects, Engine, SceneBuilder, preset
from jax2d.warp.memory import table_bytes, thread_bytes

CAPACITY = Capacity(polygons=30, circles=7, joints=3, thrusters=2)


def test_tables_hold_as_many_bytes_as_the_layout_says() -> None:
    world = SceneBuilder(CAPACITY).build()
    engine = Engine(CAPACITY)
    scene, state = jax.tree.map(lambda x: x[None], (world.scene, engine.initial_state(*world)))
    scene, state, controls = engine.pack_scene(scene), engine.pack_state(state), engine.no_controls(1)
    expected = table_bytes(CAPACITY)
    for name, tree in (("scene", scene.tables), ("state", state), ("controls", controls)):
        assert expected[name] == sum(leaf.nbytes for leaf in jax.tree.leaves(tree)), name
    # Bits of who touches whom, at the end and during the call, and three counters.
    assert expected["out"] == 4 * (2 * CAPACITY.shapes * CAPACITY.touch_words + 3)


@pytest.mark.slow
def test_local_memory_of_a_thread_is_read_from_the_compiled_kernel() -> None:
    sizes = []
    for contacts in (10, 20):
        effects = Effects(circle_pairs=True, circle_slots=10, contact_slots=contacts)
        sizes.append(
            thread_bytes(Capacity(polygons=0, circles=10, joints=0, thrusters=0), preset("standard"), effects, "9.0")
        )
    bytes_of_a_contact = (sizes[1] - sizes[0]) / 10
    assert 60 <= bytes_of_a_contact <= 100  # 19 numbers
