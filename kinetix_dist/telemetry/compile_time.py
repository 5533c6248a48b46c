"""How long this process has spent compiling, as JAX tells it."""

from __future__ import annotations

import threading

# Of jax.monitoring. Tracing is left out: its events nest, so that their sum would count it several times.
_COMPILE_EVENTS = ("to_mlir_module_duration", "backend_compile_duration")
_seconds: list[float] = []
_lock = threading.Lock()


def count_compile_seconds() -> None:
    """Begins to count, once a process."""
    import jax

    if not _seconds:
        _seconds.append(0.0)
        jax.monitoring.register_event_duration_secs_listener(_add_event)


def compile_seconds() -> float:
    """s of lowering and compiling since counting began, summed over threads. A hit of the cache takes little."""
    return _seconds[0] if _seconds else 0.0


def _add_event(event: str, duration: float, **details: object) -> None:
    del details
    if event.startswith("/jax/core/compile/") and event.endswith(_COMPILE_EVENTS):
        with _lock:
            _seconds[0] += duration
