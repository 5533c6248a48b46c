"""Curricula by name, `CurriculumConfig.name`. One file each, see `curriculum.py`.

| name | levels of an update |
|---|---|
| `sfl` | a share from a buffer of learnable levels, the rest fresh from the generator |
| `sfl_slices` | the same; a refresh renews part of the buffer, and levels leave by what training made of them |
| `plr` | a share from a buffer of levels of high score, by rank and staleness, the rest fresh |
| `robust_plr` | the same; fresh levels give no gradient |
| `accel` | the same; part of what is fresh there are levels of the buffer with random changes |
| `paired` | built by a teacher that looks for what a second student can and the policy cannot |
| `domain_randomization` | all fresh from the generator |
| `fixed` | a given set, spread evenly |
"""

from __future__ import annotations

from kinetix_dist.curator.accel import Accel
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.curator.paired import Paired
from kinetix_dist.curator.plr import Plr, RobustPlr
from kinetix_dist.curator.sfl import Sfl
from kinetix_dist.curator.sfl_slices import SflSlices
from kinetix_dist.curator.stateless import DomainRandomization, Fixed
from kinetix_dist.level.size_mixture import counts_of
from kinetix_dist.registry import Registry

CURRICULA: Registry[type[Curriculum]] = Registry("curriculum")
CURRICULA.register("sfl", Sfl)
CURRICULA.register("sfl_slices", SflSlices)
CURRICULA.register("plr", Plr)
CURRICULA.register("robust_plr", RobustPlr)
CURRICULA.register("accel", Accel)
CURRICULA.register("paired", Paired)
CURRICULA.register("domain_randomization", DomainRandomization)
CURRICULA.register("fixed", Fixed)


def curriculum_class(config: CurriculumConfig, worlds_per_group: int) -> type[Curriculum]:
    """The curriculum of a configuration. Raises ValueError for an unknown one, and for what it cannot run with."""
    kind = CURRICULA[config.name]
    if kind.takes_levels != bool(config.levels):
        raise ValueError(
            f"CurriculumConfig.levels is {config.levels!r} with name {config.name!r}; a level set is needed for "
            f"{', '.join(repr(name) for name in CURRICULA if CURRICULA[name].takes_levels)} and for no other"
        )
    kind.check(config, worlds_per_group)
    if not (config.filter_noop or kind.draws_levels):
        raise ValueError(
            f"CurriculumConfig.filter_noop is False, but curriculum {config.name!r} draws no random levels, of which "
            "any would be filtered; leave it out"
        )
    if config.sizes:
        if not kind.draws_levels:
            raise ValueError(
                f"CurriculumConfig.sizes is given, but curriculum {config.name!r} draws no random levels; leave it out"
            )
        if num_fresh := kind.num_fresh(config, worlds_per_group):
            _ = counts_of(config.sizes, num_fresh)  # raises where a size would have no level in a group
    return kind
