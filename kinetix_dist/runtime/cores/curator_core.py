"""Core of a curator: a curriculum that refreshes, from parameters and a key. Plain JAX on the devices it has."""

from __future__ import annotations

import time
from typing import Any

import jax

from kinetix_dist import prng
from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.runtime.cores.playing import Playing
from kinetix_dist.runtime.cores.run_names import CURATE, PROBE, stream


class CuratorCore:
    """Refreshes with given parameters. The same (parameters, version) give the same answer, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._playing = Playing(config, data_mesh())
        self._playing.curriculum(config)  # a level set that cannot be loaded is found before the first request
        self._params: Any = None  # shapes of the parameters of requests
        self._prepared: Curriculum | None = None  # whose probe is compiled

    def refresh(
        self, params: Any, policy_version: int, part: int, num_parts: int, probe: Any = None, given: Any = None
    ) -> tuple[dict[str, Any], Any]:
        """({"seconds": how long it took, "probe": what became of `probe`}, this part of what the curriculum joins and
        adopts, as numpy). probe: levels of the buffer in use, played again with a key of their own; None: no such.
        given: of `Curriculum.refresh_input`, or the same arrays in nested dictionaries, as a checkpoint gives them."""
        began = time.monotonic()
        params = jax.device_put(params)
        self._params = jax.eval_shape(lambda: params)
        config, curriculum = self._config, self._curriculum(policy_version)
        key = prng.fold_in(stream(config.run.seed, CURATE), policy_version)
        if given is not None:
            template = jax.eval_shape(lambda: curriculum.refresh_input(curriculum.init()))
            given = unflatten_arrays(template, flatten_arrays(given))
        refreshed = curriculum.refresh_part(params, policy_version, key, part, num_parts, given)
        refreshed = jax.device_get(refreshed)
        played = {}
        if probe is not None:
            probe_key = prng.fold_in(stream(config.run.seed, PROBE), policy_version)
            played = curriculum.play_probe(params, probe, probe_key)
        return {"seconds": time.monotonic() - began, "probe": played}, refreshed

    def compile_ahead(self, params: Any, policy_version: int) -> None:
        """Compiles the programs of the refresh of that version which take longest."""
        self._curriculum(policy_version).compile_refresh(params)

    def prepare(self, policy_version: int) -> None:
        """Compiles what the refresh of that version may need beyond those before: its probe. For a process that has
        answered one and waits for the next, so that training does not wait for the compiler then."""
        assert self._params is not None, "a curator prepares for a refresh after its first one"
        curriculum = self._curriculum(policy_version)
        if curriculum is not self._prepared:
            self._prepared = curriculum
            curriculum.compile_probe(self._params, self._config.curriculum_log.probe_levels)

    def _curriculum(self, policy_version: int) -> Curriculum:
        """Curriculum of the phase in which the refresh is adopted, so that its first buffer has the levels of that
        phase."""
        config = self._config
        return self._playing.curriculum(config.schedule.at(config.refresh_times.adopted_at(policy_version)).config)
