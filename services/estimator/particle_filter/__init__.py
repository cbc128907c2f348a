"""A particle filter like AMCL, for comparison on the same topics."""

from services.estimator.particle_filter.filter import ParticleFilter
from services.estimator.particle_filter.settings import ParticleFilterSettings

__all__ = ["ParticleFilter", "ParticleFilterSettings"]
