"""How processes are started and watched: backends, the Ray actor, placement, memory of GPUs, heartbeats, watchdog.

Called by `runtime/driver/`, and by commands that ask what fits on this machine (`placement`). Nothing here knows what a
process computes: a core is whatever `build(index, number of processes, *arguments)` returns.
"""
