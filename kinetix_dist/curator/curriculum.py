"""Which levels are played next: `propose` gives those of an update, from a buffer that is refreshed now and then.

| name | levels of an update |
|---|---|
| `sfl` | a share from a buffer of learnable levels, the rest fresh from the generator |
| `domain_randomization` | all fresh from the generator |
| `fixed` | a given set, spread evenly |

`propose` runs inside jit on each device for the world groups that live there. Its keys are those of the groups, so
the levels of an update are the same on any number of devices.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Capacity
from kinetix_dist.curator.domain_randomization import fresh_levels
from kinetix_dist.curator.level_buffer import LevelBuffer, draw
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level

CURRICULA = ("sfl", "domain_randomization", "fixed")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurriculumConfig:
    """Defaults are those of the paper's SFL."""

    name: str = "sfl"  # "sfl", "domain_randomization" or "fixed"
    levels: str = ""  # for "fixed": the level set to train on, a name or a path
    num_candidates: int = 12288  # N, fresh levels scored in a refresh
    scoring_steps: int = 512  # L, environment steps played on each candidate
    scoring_batch: int = 4096  # candidates scored at once, bounds memory
    refresh_every: int = 128  # T, updates between refreshes
    adopt_after: int = 4  # updates from the request of a refresh to its adoption, while scoring is free
    buffer_size: int = 1024  # K, levels kept
    buffer_share: float = 0.5  # rho, share of the worlds that play levels of the buffer
    generator: GeneratorConfig = dataclasses.field(default_factory=GeneratorConfig)

    def __post_init__(self) -> None:
        if self.name not in CURRICULA:
            raise ValueError(f"CurriculumConfig.name is {self.name!r}; curricula are {', '.join(CURRICULA)}")
        if (self.name == "fixed") != bool(self.levels):
            raise ValueError(
                f"CurriculumConfig.levels is {self.levels!r} with name {self.name!r}; "
                "a level set is needed for 'fixed' and for no other"
            )
        for name in ("num_candidates", "scoring_steps", "scoring_batch", "refresh_every", "adopt_after", "buffer_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"CurriculumConfig.{name} is {getattr(self, name)}; it must be 1 or more")
        if self.num_candidates % self.scoring_batch:
            raise ValueError(
                f"CurriculumConfig.num_candidates {self.num_candidates} is not a multiple of scoring_batch "
                f"{self.scoring_batch}; change one of them"
            )
        if self.buffer_size > self.num_candidates:
            raise ValueError(
                f"CurriculumConfig.buffer_size {self.buffer_size} is larger than num_candidates {self.num_candidates}"
            )
        if self.adopt_after > self.refresh_every:
            raise ValueError(
                f"CurriculumConfig.adopt_after {self.adopt_after} is larger than refresh_every {self.refresh_every}: "
                "a second refresh would be asked for before the first is adopted"
            )
        if not 0.0 < self.buffer_share <= 1.0:
            raise ValueError(
                f"CurriculumConfig.buffer_share is {self.buffer_share}; it must be above 0 and at most 1 "
                "(for no buffer use name 'domain_randomization')"
            )

    @property
    def has_buffer(self) -> bool:
        return self.name == "sfl"

    def is_refresh_due(self, num_updates: int) -> bool:
        """Whether a refresh is asked for at the start of this update, with the policy version of that number."""
        return self.has_buffer and num_updates % self.refresh_every == 0

    def adopted_at(self, requested_at: int) -> int:
        """The update that first uses the buffer asked for at `requested_at`. The first buffer is used at once."""
        return requested_at if requested_at == 0 else requested_at + self.adopt_after


# (group keys [g], numbers of the groups [g], buffer or None) -> levels of these groups, [g * worlds_per_group]
Propose = Callable[[Array, Array, LevelBuffer | None], Level]


def make_propose(
    config: CurriculumConfig,
    *,
    capacity: Capacity,
    worlds_per_group: int,
    noop_solved: Callable[[Level], Array],
    fixed_levels: Level | None = None,
) -> Propose:
    """The proposing half of a curriculum, pure. A group's worlds are those of the buffer first, then the fresh ones."""
    if config.name == "fixed":
        if fixed_levels is None:
            raise ValueError("curriculum 'fixed' needs its levels")
        return _propose_fixed(fixed_levels, worlds_per_group)
    num_buffered = from_buffer(config, worlds_per_group)
    num_fresh = worlds_per_group - num_buffered

    def propose(group_keys: Array, group_index: Array, buffer: LevelBuffer | None) -> Level:
        del group_index
        num_groups = group_keys.shape[0]
        split = jax.vmap(jax.random.split)(group_keys)
        parts = []
        if num_buffered:
            if buffer is None:
                raise ValueError("a curriculum with a buffer was asked for levels before it was filled")
            parts.append(jax.vmap(lambda key: draw(key, buffer, num_buffered))(split[:, 0]))
        if num_fresh:
            fresh = fresh_levels(
                split[:, 1], num_fresh, capacity=capacity, generator=config.generator, noop_solved=noop_solved
            )
            parts.append(jax.tree.map(lambda x: x.reshape(num_groups, num_fresh, *x.shape[1:]), fresh))
        return jax.tree.map(
            lambda *xs: jnp.concatenate(xs, axis=1).reshape(num_groups * worlds_per_group, *xs[0].shape[2:]), *parts
        )

    return propose


def from_buffer(config: CurriculumConfig, worlds_per_group: int) -> int:
    """Worlds of a group that play levels of the buffer; raises where the share is not a whole number of worlds."""
    if not config.has_buffer:
        return 0
    exact = config.buffer_share * worlds_per_group
    if abs(exact - round(exact)) > 1e-6:
        raise ValueError(
            f"buffer_share {config.buffer_share} of {worlds_per_group} worlds a group is {exact:g}, no whole number; "
            "change buffer_share or the number of environments"
        )
    return round(exact)


def _propose_fixed(levels: Level, worlds_per_group: int) -> Propose:
    num_levels = levels.position.shape[0]

    def propose(group_keys: Array, group_index: Array, buffer: LevelBuffer | None) -> Level:
        del group_keys, buffer
        world = (group_index[:, None] * worlds_per_group + jnp.arange(worlds_per_group)).reshape(-1)
        return jax.tree.map(lambda x: jnp.asarray(x)[world % num_levels], levels)

    return propose
