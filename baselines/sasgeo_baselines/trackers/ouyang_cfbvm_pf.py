# SPDX-License-Identifier: Apache-2.0
"""`ouyang_cfbvm_pf`: coarse-to-fine matching of buildings gives a mixture that weighs particles (Ouyang)."""

from collections import deque
from typing import Final

import numpy as np

import sasgeo_bench as sgb
from sasgeo_baselines.building_votes import REACH_M, Seen, Town, headings, mixture_of
from sasgeo_baselines.trackers.particles import TRAINED_ON, Floats, Noise, ParticleFilter, Particles

# Likelihood of any other place, where a perfect vote adds 1. `benchmarks/fit_particle_filters.py --floors` tries 1 to
# 0.01 on made-up towns: 0.03 and 0.01 keep most views within 25 m, 0.83 of 1,126, and the larger trusts votes less.
FLOOR: Final = 0.03
COUNT: Final = 20_000
FEWEST: Final = 1_000
CREDIBLE: Final = 0.6
HELD: Final = 3  # updates


class OuyangCfbvmPf(ParticleFilter):
    """Rings of building area, votes of shapes, a mixture as likelihood, and fixes that are credible."""

    card = sgb.MatcherCard(
        name="ouyang_cfbvm_pf",
        version="1",
        title="Coarse-to-fine building matching and a particle filter",
        source=(
            "Ouyang et al., Defence Technology 34(4), 2024: its abstract, its released filter, and a public account of "
            "the coarse stage"
        ),
        ours=(
            "The source's: windows of a vector map by the building area in six rings, shapes of buildings matched in "
            "them, votes for a translation, a Gaussian mixture as likelihood, fewer particles as they gather, an "
            "indicator of credibility that suppresses fixes; noise of 3.3 m along each axis (there added to steps of "
            "true positions, here on top of the odometer's covariance; 1 km and 90 degrees where it lost its way). "
            "Ours, since the abstract does not say: 50 windows by z-scores, at places 24 m apart within 2.5 spreads "
            "of the particles; eight numbers of a shape; mutual best pairs with a correlation above 0.9; mean shift "
            "of 12 m; heights of votes x correlation over a floor of 0.03, chosen on made-up towns; 20,000 to 1,000 "
            "particles; credibility = mass of the heaviest cluster x (1 - spread / spread at the start), above 0.6 "
            "for 3 views. Buildings are patches of the raster on both sides; headings 8 degrees apart are tried "
            "within 2.5 standard deviations of the particles, where the source has a compass"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        trained_on=TRAINED_ON,
        limits=(
            "Blind where no whole building is in a view; ground that the map does not know counts as empty; errors of "
            "a detector change shapes, so that a right pair seldom correlates above 0.9; houses that are alike vote "
            "for each other's places, and where all are, as in a planned quarter, it finds nothing; with an unknown "
            "heading it tries 45"
        ),
    )
    count = COUNT
    noise = Noise(place_m=3.3)

    def __init__(self, *, floor: float = FLOOR) -> None:
        super().__init__()
        self.floor = floor
        self._held: deque[bool] = deque(maxlen=HELD)

    def read(self, region: sgb.Region) -> None:
        """Index buildings and windows."""
        self._town = Town.of(region)
        self._bounds_m = region.grid.bounds_m

    def start(self, prior: sgb.Prior) -> None:
        """Begin a flight."""
        super().start(prior)
        self._held.clear()

    def likelihood(self, particles: Particles, query: sgb.Query) -> Floats:
        """Return the mixture and its floor, 0 beyond the map."""
        west_m, south_m, east_m, north_m = self._bounds_m
        is_inside = ((particles.place_m >= (west_m, south_m)) & (particles.place_m <= (east_m, north_m))).all(axis=1)
        pose = particles.mean
        around = sgb.Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=2.5 * particles.spread_m + 2 * REACH_M)
        yaws_deg = headings(pose.yaw_deg, float(np.sqrt(particles.covariance[2, 2])))
        votes = self._town.votes(Seen.of(query.evidence), around, yaws_deg=yaws_deg)
        found = mixture_of(votes).at(particles.place_m, particles.yaw_deg) if len(votes) else 0.0
        return np.asarray(np.where(is_inside, self.floor + found, 0.0))

    def estimate(self, particles: Particles) -> sgb.Fix:
        """Return the mean of the heaviest cluster; accepted where it has been credible for some views."""
        cluster = particles.heaviest_cluster(reach_m=30.0, least=20)
        chosen = particles.within(cluster.members)
        remaining = particles.spread_m / max(self.start_spread_m, 1.0)
        credibility = cluster.mass * max(0.0, 1.0 - remaining)
        self._held.append(credibility >= CREDIBLE)
        return sgb.Fix(
            pose=chosen.mean,
            covariance=chosen.covariance,
            is_accepted=len(self._held) == HELD and all(self._held),
            confidence=particles.share_near(chosen.mean),
            diagnostics={"credibility": credibility, "spread_m": particles.spread_m, "particles": len(particles)},
        )

    def settled(self, particles: Particles, *, rng: np.random.Generator) -> Particles:
        """Resample where half of the particles are effective: as many as their spread asks for."""
        if particles.effective_count >= len(particles) / 2:
            return particles
        count = round(COUNT * min(1.0, particles.spread_m / max(self.start_spread_m, 1.0)))
        return particles.resampled(min(max(count, FEWEST), self.count), rng=rng)
