"""Parameters under AMCL's names: AMCL-like defaults, and a set tuned for laser alone."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from common.errors import UserError

LaserModel = Literal["likelihood_field", "likelihood_field_prob", "beam"]
MotionModel = Literal["omni", "differential"]


@dataclass(frozen=True)
class Settings:
    """As nav2_amcl 1.x documents them; those without a name there come last.

    nav2 filters a scan only after the robot has moved by update_min_d or update_min_a. Here every scan is filtered
    (both are 0 in either set): there may be no odometry that could tell of a motion.
    """

    alpha1: float = 0.2  # turning noise by turning
    alpha2: float = 0.2  # turning noise by path
    alpha3: float = 0.2  # path noise by path
    alpha4: float = 0.2  # path noise by turning
    alpha5: float = 0.2  # sideways noise by path, omni only
    robot_model_type: MotionModel = "differential"
    laser_model_type: LaserModel = "likelihood_field"
    max_beams: int | None = 60  # evenly spaced over the scan; None: all
    laser_likelihood_max_dist: float = 2.0  # m, distances beyond count as this
    z_hit: float = 0.5
    z_short: float = 0.05
    z_max: float = 0.05
    z_rand: float = 0.5
    sigma_hit: float = 0.2  # m
    lambda_short: float = 0.1  # 1/m
    min_particles: int = 500
    max_particles: int = 2000
    pf_err: float = 0.05  # Kullback-Leibler distance allowed to the sampled belief
    pf_z: float = 0.99  # quantile of the standard normal; nav2 hands this number to the formula as it is
    recovery_alpha_slow: float = 0.0  # 0: no random particles
    recovery_alpha_fast: float = 0.0
    keep_initial_pose: bool = True  # a pose that was given is never given up for a search: no recovery
    resample_interval: int = 1  # scans
    resolution: float = 0.05  # m, cells of the likelihood field and of the beam model's table
    sigma_search: float = 0.0  # m, replaces sigma_hit while the particles are spread; 0: never
    sigma_odometry: float = 0.0  # m, with all beams, replaces sigma_hit once found while there is odometry; 0: never
    search_share: float = 0.0  # of the particles keep weight while sigma is wide, by tempering; 0: none need to
    odometry_share: float = 0.0  # the same while sigma_odometry holds: a single particle would have no covariance
    jitter_position: float = 0.05  # m in 1/15 s, random walk where neither odometry nor command is known
    jitter_heading: float = 0.05  # rad in 1/15 s
    walk_share: float = 1.0  # of the particles take that walk, the others stay: a robot that stands is found exactly
    floor_position: float = 0.0  # m a scan, added to every motion: copies of one particle part again
    floor_heading: float = 0.0  # rad a scan

    def __post_init__(self) -> None:
        """Raises UserError on what cannot be filtered with."""
        numbers = [f.name for f in fields(self) if f.type in ("float", "int", "int | None")]
        negative = [name for name in numbers if (value := getattr(self, name)) is not None and not value >= 0]
        positive = ("sigma_hit", "lambda_short", "pf_err", "resolution", "min_particles", "resample_interval")
        if negative or any(getattr(self, name) == 0 for name in positive) or self.max_beams == 0:
            named = negative or [name for name in (*positive, "max_beams") if getattr(self, name) == 0]
            raise UserError(
                f"particle filter: {', '.join(named)} must be greater than 0 (noise and weights: not below)"
            )
        if self.max_particles < self.min_particles:
            raise UserError(f"particle filter: max_particles {self.max_particles} < min_particles {self.min_particles}")
        if self.z_hit == 0 or self.z_rand == 0:
            raise UserError("particle filter: z_hit and z_rand must be greater than 0, or one beam decides alone")

    @classmethod
    def tuned(cls) -> Settings:
        """What finds and holds a pose by laser alone: the best AMCL is known to do, and more particles to search."""
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
