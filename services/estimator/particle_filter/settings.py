"""Parameters under AMCL's names: AMCL-like defaults, and a set tuned for laser alone."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from common.errors import UserError

LaserModel = Literal["likelihood_field", "likelihood_field_prob", "beam"]
MotionModel = Literal["omni", "differential"]
POSITIVE = ("sigma_hit", "lambda_short", "pf_err", "resolution", "min_particles", "resample_interval", "max_beams")
SHARES = ("recovery_alpha_slow", "recovery_alpha_fast", "search_share", "odometry_share", "walk_share")


@dataclass(frozen=True)
class ParticleFilterSettings:
    """Parameters of the particle filter.

    The first ones have the names and meanings of nav2_amcl 1.x; those that it does not have come last. nav2 processes a
    scan only after the robot has moved by update_min_d or update_min_a. Here every scan is processed, as with both set
    to 0, because there may be no odometry from which to tell that the robot moved.
    """

    alpha1: float = 0.2  # noise of turning, caused by turning
    alpha2: float = 0.2  # noise of turning, caused by the path
    alpha3: float = 0.2  # noise of the path, caused by the path
    alpha4: float = 0.2  # noise of the path, caused by turning
    alpha5: float = 0.2  # noise sideways, caused by the path; omni only
    robot_model_type: MotionModel = "differential"
    laser_model_type: LaserModel = "likelihood_field"
    max_beams: int | None = 60  # evenly spaced over the scan; None uses all
    laser_likelihood_max_dist: float = 2.0  # m, larger distances to obstacles are replaced by this
    z_hit: float = 0.5
    z_short: float = 0.05
    z_max: float = 0.05
    z_rand: float = 0.5
    sigma_hit: float = 0.2  # m
    lambda_short: float = 0.1  # 1/m
    min_particles: int = 500
    max_particles: int = 2000
    pf_err: float = 0.05  # largest Kullback-Leibler divergence of the sampled belief from the true one
    pf_z: float = 0.99  # quantile of the standard normal, inserted into the formula directly, as in nav2
    recovery_alpha_slow: float = 0.0  # 0 disables random particles
    recovery_alpha_fast: float = 0.0
    keep_initial_pose: bool = True  # never search elsewhere after a pose was given: disables recovery
    resample_interval: int = 1  # scans
    # Parameters that nav2_amcl does not have:
    resolution: float = 0.05  # m, cells of the likelihood field and of the beam model's table
    sigma_search: float = 0.0  # m, replaces sigma_hit while the particles are spread; 0 disables it
    sigma_odometry: float = 0.0  # m, replaces sigma_hit, with all beams, while tracking with odometry; 0 disables it
    search_share: float = 0.0  # minimum effective share of particles during a search, by tempering; 0 disables it
    odometry_share: float = 0.0  # the same while sigma_odometry is used: one particle would have no covariance
    jitter_position: float = 0.05  # m per 1/15 s, random walk if there is neither odometry nor a command
    jitter_heading: float = 0.05  # rad per 1/15 s
    walk_share: float = 1.0  # share of particles in that random walk; the others stay, in case the robot stands still
    floor_position: float = 0.0  # m per scan, added to every motion so that copies of one particle separate
    floor_heading: float = 0.0  # rad per scan

    def __post_init__(self) -> None:
        """Raises UserError for values with which the filter cannot work."""
        numbers = [f.name for f in fields(self) if f.type in ("float", "int", "int | None")]
        if negative := [name for name in numbers if (value := getattr(self, name)) is not None and not value >= 0]:
            raise UserError(f"particle filter: {', '.join(negative)} must not be negative")
        if zero := [name for name in POSITIVE if getattr(self, name) == 0]:
            raise UserError(f"particle filter: {', '.join(zero)} must be greater than 0")
        if large := [name for name in SHARES if getattr(self, name) > 1]:
            raise UserError(f"particle filter: {', '.join(large)} must be 1 at most")
        if self.max_particles < self.min_particles:
            raise UserError(f"particle filter: max_particles {self.max_particles} < min_particles {self.min_particles}")
        if self.z_hit == 0 or self.z_rand == 0:
            raise UserError(
                "particle filter: z_hit and z_rand must be greater than 0, because otherwise a single beam would decide"
            )

    @classmethod
    def tuned(cls) -> ParticleFilterSettings:
        """Settings with which the filter localises and tracks by laser alone, with more particles for the search."""
        return cls(
            robot_model_type="omni",
            laser_model_type="likelihood_field_prob",
            z_hit=0.95,
            z_rand=0.05,
            max_beams=180,
            sigma_hit=0.1,
            sigma_odometry=0.05,
            sigma_search=0.5,
            search_share=0.05,
            odometry_share=0.005,
            min_particles=2000,
            max_particles=20_000,
            walk_share=0.95,
            recovery_alpha_slow=0.02,
            recovery_alpha_fast=0.3,
            floor_position=0.001,
            floor_heading=0.0005,
        )
