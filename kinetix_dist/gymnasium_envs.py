"""Registers the environments with gymnasium, without importing JAX.

    import gymnasium
    import kinetix_dist.gymnasium_envs

    envs = gymnasium.make_vec("kinetix-dist/M-v0", num_envs=4, levels="designed_m", observation="flat")
    env = gymnasium.make("kinetix-dist/S-v0")

Keyword arguments are those of `kinetix_dist.env.wrappers.gymnasium_env.make` and `make_vec`.
"""

import gymnasium

MODULE = "kinetix_dist.env.wrappers.gymnasium_env"
IDS = {size: f"kinetix-dist/{size.upper()}-v0" for size in ("s", "m", "l")}

for _size, _id in IDS.items():
    gymnasium.register(
        _id, entry_point=f"{MODULE}:make", vector_entry_point=f"{MODULE}:make_vec", kwargs={"size": _size}
    )
