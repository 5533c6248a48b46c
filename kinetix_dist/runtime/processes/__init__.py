"""Processes of a run: back ends, the Ray actor, placement, memory of GPUs, heartbeats, watchdog.

Nothing here knows what a process computes: a core is the object that `build(index, number of processes, *arguments)`
returns.
"""

import os

# Ray turns 127.0.0.1 into the address of the host, and listens there for all hosts, unless this is set before it is
# imported. Its name is of systems where that is the default.
if "RAY_ADDRESS" not in os.environ:
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
