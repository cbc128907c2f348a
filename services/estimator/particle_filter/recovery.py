"""Augmented MCL (Thrun et al. 2005, table 8.3)."""

from __future__ import annotations

from dataclasses import dataclass

# Most particles stay where the belief is: people that block half the beams must not cost a pose that is right.
MOST_RANDOM = 0.4


@dataclass
class Recovery:
    """Short- and long-term average of how well the particles explain the scans.

    AMCL averages the particles' likelihoods. A product over many beams jumps by e^20 from one good scan to the next,
    and changes with sigma; what is averaged here is the fit of a beam at the estimate, see `Explanation.fit`.
    """

    alpha_slow: float
    alpha_fast: float
    slow: float = 0.0
    fast: float = 0.0

    def add(self, fit: float) -> None:
        """Take in how well one scan fitted, > 0."""
        if self.slow == 0.0:
            self.slow = self.fast = fit
        self.slow += self.alpha_slow * (fit - self.slow)
        self.fast += self.alpha_fast * (fit - self.fast)

    def converged(self) -> None:
        """The long-term average forgets the search, whose poor fits would hide a later kidnapping."""
        self.slow = max(self.slow, self.fast)

    def accept(self) -> None:
        """Scans fit as well as they will: it is the world that changed."""
        self.slow = self.fast

    @property
    def ratio(self) -> float:
        """Short- over long-term average; 1 before the first scan."""
        return self.fast / self.slow if self.slow > 0 else 1.0

    @property
    def random_share(self) -> float:
        """Share of particles to draw at random over free space."""
        return min(MOST_RANDOM, max(0.0, 1.0 - self.ratio))
