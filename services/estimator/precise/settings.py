"""Parameters of the precise estimator."""

from __future__ import annotations

from dataclasses import dataclass, field

from services.estimator.precise.motion_model import MotionNoise


@dataclass(frozen=True)
class Settings:
    """What can be set; defaults hold for every shipped world."""

    seeds: int = 48  # poses descended in the first round of a search
    more_seeds: int = 240  # in the second, where the first explains too little
    beams: int = 150  # of the descent from seeds; the last steps take all
    satisfied: float = 0.9  # share of beams explained that ends a search
    good: float = 0.75  # share of beams from which another place may soon follow one that was tracked
    doubtful: float = 0.45  # share of beams below which what contradicts a place voids the claim to it
    believable: float = 0.45  # least share of beams that a belief must explain
    glimpse: float = 0.15  # the same, of one that was tracked, while what it does not explain stands in the way
    contradicted: float = 0.05  # share of the beams that may end behind what such a belief expects
    holding: float = 0.004  # share of the beams on surfaces turned that way that hold a place along a direction
    drop: float = 0.1  # fall of the share explained that calls for a search
    evidence_error: float = 20.0  # nats by which a model's error may set two places apart
    ambiguous: float = 0.05  # weight of a second hypothesis from which the belief is ambiguous
    hypotheses: int = 8
    inflation: float = 1.0  # of the covariance, for errors of the model that hang together
    floor_position: float = 0.0  # m, standard deviation that no scan takes away, in x and in y
    floor_heading: float = 0.0  # rad
    sure: float = 0.75  # share of beams from which one scan is enough to say tracking
    patience: int = 30  # scans that a place must persist with less
    probation: int = 100  # scans for which a place that explains less than that must persist to follow another
    rise: float = 150.0  # nats by which accuracy must worsen at once to call for a search
    vague: float = 0.5  # m, standard deviation of a position that is not known
    motion: MotionNoise = field(default_factory=MotionNoise)
