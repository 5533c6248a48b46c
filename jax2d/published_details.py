"""Details of the published package (jax2d 1.0.2) that differ from the paper's appendix, or that it leaves open.

Names for `Settings.published_details`, for comparison with it; what each means in the solver is in jax2d/xla. What the
appendix does prescribe is always on in preset `paper`; docs/engine_solver.md lists both.
"""

PUBLISHED_DETAILS: dict[str, str] = {
    # Manifolds
    "reference_bias": "the reference face is that of the polygon in the lower slot unless the other overlaps 1 cm less",
    "clip_keeps_depth": "clipping the incident face moves a corner along the reference face and keeps its depth",
    "deepest_depth": "both points of a manifold get the deepest depth",
    "centre_inside": "a circle whose centre is inside a polygon is as deep as its radius; on the edge it has no normal",
    "coincident_circles": "circles with the same centre have no normal and never separate",
    "fixed_slots": "polygons in slots 0 to 3, meant for floor and walls, never collide with each other",
    # Solving
    "warm_start_by_depth": "impulses are matched by pair and order of depth",
    "solve_order": "by kind of pair, deepest points first, over batches that start where the number in contact says",
    "arms_follow_joints": "contact arms lead from centres of mass as the joints' positional correction has moved them",
    "last_pair": "impulses of the last pair of a kind are dropped in every iteration unless its batches are full",
    "state_clips": "after a step coordinates are clipped to 15 m and velocities to max_speed a component",
}
