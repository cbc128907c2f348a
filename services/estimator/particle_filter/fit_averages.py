"""Augmented MCL (Thrun et al. 2005, table 8.3)."""

from __future__ import annotations

from dataclasses import dataclass

# Most particles always stay at the belief, so that people who block half of the beams do not make the filter lose it.
MAX_RANDOM_SHARE = 0.4


@dataclass
class FitAverages:
    """Short- and long-term averages of how well the estimate explains the scans.

    AMCL averages the particles' likelihoods. These are products over many beams, which vary by e^20 between good scans
    and change with sigma. So here the fit of a single beam at the estimate is averaged, see `ScanFit.fit`.
    """

    alpha_slow: float
    alpha_fast: float
    slow: float = 0.0
    fast: float = 0.0

    def add(self, fit: float) -> None:
        """Updates the averages with the fit of one scan, greater than 0."""
        if self.slow == 0.0:
            self.slow = self.fast = fit
        self.slow += self.alpha_slow * (fit - self.slow)
        self.fast += self.alpha_fast * (fit - self.fast)

    def converged(self) -> None:
        """Removes the poor fits of a search from the long-term average, where they would hide a later kidnapping."""
        self.slow = max(self.slow, self.fast)

    def accept(self) -> None:
        """Accepts the present fit as normal, because the world has changed."""
        self.slow = self.fast

    @property
    def ratio(self) -> float:
        """Ratio of the short-term to the long-term average; 1 before the first scan."""
        return self.fast / self.slow if self.slow > 0 else 1.0

    @property
    def random_share(self) -> float:
        """Share of particles to draw at random from free space."""
        return min(MAX_RANDOM_SHARE, max(0.0, 1.0 - self.ratio))
