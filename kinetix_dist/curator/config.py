"""Section `curriculum` of a run's configuration."""

from __future__ import annotations

import dataclasses
import itertools

from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.size_mixture import check_weights
from kinetix_dist.setting import MAX_LAYERS, MAX_WIDTH, ConfigError, check_settings, setting

# Sections of `CurriculumConfig` that only those curricula read that name them in `Curriculum.sections`.
OWN_SECTIONS = ("plr", "accel", "paired", "slices")
PRIORITISATIONS = ("rank", "top_k")
ANTAGONIST_RETURNS = ("mean", "max")
MAX_ATTEMPTS = 1 << 16  # per candidate: a quarter of its square is an int32, see `halving.py`


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlrConfig:
    """Choice of levels that Prioritized Level Replay plays again (Jiang et al. 2021, section 3).

    Defaults are those of the paper on Kinetix. There an update draws thousands of levels: with a temperature of 0.3, as
    of Jiang et al. for a few at a time, 87 % of those drawn by score would be one level.
    """

    score: str = "max_mc"  # of `REPLAY_SCORES` in kinetix_dist/curator/scores.py
    prioritisation: str = setting("rank", choices=PRIORITISATIONS)  # by rank, or "top_k": the best alike
    temperature: float = setting(1.0, above=0)  # beta; towards 0 only the best level is played
    top_k: int = setting(256, minimum=1)  # levels
    staleness: float = setting(0.3, minimum=0, maximum=1)  # rho, share of the draws by how long ago a level was played

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AccelConfig:
    """Share of new levels that are children of levels in the buffer, and their distance (Parker-Holder et al. 2022)."""

    edited_share: float = 0.5  # of the worlds that play new levels; the others, one a group or more, play fresh ones
    num_changes: int = setting(3, minimum=1)  # random mutators from a level to its child

    def __post_init__(self) -> None:
        check_settings(self)
        if not 0.0 < self.edited_share < 1.0:
            raise ConfigError(
                f"AccelConfig.edited_share is {self.edited_share}; it must be above 0 (for none use name 'robust_plr') "
                "and below 1: fresh levels fill the buffer first"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairedConfig:
    """Learning of the teacher of PAIRED (Dennis et al. 2020); other settings are those of `ppo`."""

    antagonist_return: str = setting("mean", choices=ANTAGONIST_RETURNS)  # or "max": of its returns on a level
    hidden_size: int = setting(128, minimum=1, maximum=MAX_WIDTH)  # of the teacher's network
    hidden_layers: int = setting(2, minimum=1, maximum=MAX_LAYERS)  # of its actor and of its critic
    learning_rate: float = setting(3e-4, above=0)
    epochs: int = setting(8, minimum=1)  # each is one gradient step, from all levels of an update
    clip: float = setting(0.2, above=0)
    entropy_coefficient: float = setting(0.01, minimum=0)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlicesConfig:
    """Renewal of the buffer of "sfl_slices": `num_candidates` and `refresh_every` are of a slice there."""

    slice_size: int = setting(256, minimum=1)  # levels of the buffer that a refresh replaces
    num_harvested: int = setting(0, minimum=0)  # candidates of a refresh, at most, that training solved as fresh levels
    attempts: tuple[int, ...] = (2, 8, 24)  # episodes of a candidate after each round of scoring, all from all rounds
    keep_one_of: tuple[int, ...] = (3, 2)  # the best of so many candidates of a scoring batch play the next round
    window: int = setting(16, minimum=1)  # plays in training, the last ones, by which a level leaves
    leave_above: float = 0.9  # solve rate in the window above which a level leaves: mastered
    leave_below: float = 0.05  # and below which it does: out of reach

    def __post_init__(self) -> None:
        check_settings(self)
        if (
            not self.attempts
            or any(after <= before for before, after in itertools.pairwise([0, *self.attempts]))
            or self.attempts[-1] > MAX_ATTEMPTS
        ):
            raise ValueError(
                f"SlicesConfig.attempts is {self.attempts}; give numbers that rise from 1 or more to {MAX_ATTEMPTS} "
                "or less"
            )
        if len(self.keep_one_of) != len(self.attempts) - 1 or any(number < 1 for number in self.keep_one_of):
            raise ValueError(
                f"SlicesConfig.keep_one_of is {self.keep_one_of} with attempts {self.attempts}; give a number of 1 or "
                "more between each two of them"
            )
        if not 0.0 <= self.leave_below < self.leave_above <= 1.0:
            raise ValueError(
                f"SlicesConfig has leave_below {self.leave_below}, leave_above {self.leave_above}; they must rise, "
                "from 0 to 1"
            )

    def num_in_rounds(self, num_candidates: int) -> tuple[int, ...]:
        """Number of candidates of a scoring batch in each round, all of them first."""
        numbers = [num_candidates]
        for one_of in self.keep_one_of:
            numbers.append(numbers[-1] // one_of)
        return tuple(numbers)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurriculumConfig:
    """Defaults are those of the paper's SFL. Each curriculum reads some of the fields."""

    name: str = "sfl"  # "sfl", "sfl_slices", "plr", "robust_plr", "accel", "paired", "domain_randomization" or "fixed"
    levels: str = ""  # level set to train on, a name or a path; for "fixed", and yours that take levels
    num_candidates: int = setting(12288, minimum=1)  # N, fresh levels scored in a refresh
    scoring_steps: int = setting(512, minimum=1)  # L, environment steps played on each candidate
    scoring_batch: int = setting(4096, minimum=1)  # candidates scored at once, bounds memory
    refresh_every: int = setting(128, minimum=1)  # T, updates between refreshes
    adopt_after: int = setting(4, minimum=1)  # updates from the request of a refresh to its adoption
    buffer_size: int = setting(1024, minimum=1)  # K, levels stored
    buffer_share: float = 0.5  # rho, share of the worlds that play levels of the buffer
    filter_noop: bool = True  # random levels that solve themselves without any action are dropped (paper, section 4)
    sizes: tuple[tuple[str, float], ...] = ()  # weights of sizes among levels drawn; (): all are of env.size
    plr: PlrConfig = dataclasses.field(default_factory=PlrConfig)
    accel: AccelConfig = dataclasses.field(default_factory=AccelConfig)
    paired: PairedConfig = dataclasses.field(default_factory=PairedConfig)
    slices: SlicesConfig = dataclasses.field(default_factory=SlicesConfig)
    generator: GeneratorConfig = dataclasses.field(default_factory=GeneratorConfig)

    def __post_init__(self) -> None:
        check_settings(self)
        check_weights("CurriculumConfig.sizes", self.sizes)
        if self.num_candidates % self.scoring_batch:
            raise ConfigError(
                f"CurriculumConfig.num_candidates {self.num_candidates} is not a multiple of scoring_batch "
                f"{self.scoring_batch}; change one of them"
            )
        if self.adopt_after > self.refresh_every:
            raise ConfigError(
                f"CurriculumConfig.adopt_after {self.adopt_after} is larger than refresh_every {self.refresh_every}: "
                "a second refresh would be requested before the first is adopted"
            )
        if not 0.0 < self.buffer_share <= 1.0:
            raise ConfigError(
                f"CurriculumConfig.buffer_share is {self.buffer_share}; it must be above 0 and at most 1 "
                "(for no buffer use name 'domain_randomization')"
            )

    @property
    def num_batches(self) -> int:
        """Batches of candidates, each scored at once."""
        return self.num_candidates // self.scoring_batch
