# SPDX-License-Identifier: Apache-2.0
"""The tracker kept-tracker: here is where your method goes."""

from dataclasses import replace

import numpy as np

from sasgeo_bench import Fix, Pose, Prior, Query, Region, advance, load_matcher, read_card, start_of, wrap_deg

FOUND = np.diag([5.0, 5.0, 3.0]) ** 2  # covariance of a pose that the search finds: m2, m2, deg2
GATE = 3.4  # largest Mahalanobis distance of a pose that is taken: 99 of 100 right ones are nearer
NEAR_M = 25.0  # an estimate is accepted while 95 % of its belief lies within
LEAST_M = 80.0  # radius that is searched at least
STREAK = 3  # poses taken in a row before the first estimate is accepted
PATIENCE = 5  # poses refused in a row before no more is believed than at the start


class KeptTracker:
    """Odometry corrected by a search, in a Kalman filter. A place to start from, no method to win with."""

    card = read_card(__file__)  # card.toml, beside this file

    def __init__(self) -> None:
        self.matcher = load_matcher("fft_vote")  # a search that ships; put your own here

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index the map; called once for each one."""
        self.matcher.prepare(region, learned)
        self.grid = region.grid

    def start(self, prior: Prior) -> None:
        """Begin a flight with what is known of its first view; forget the one before."""
        self.pose, self.covariance = start_of(prior, self.grid)
        self.begun = self.covariance
        west_m, south_m, east_m, north_m = self.grid.bounds_m
        self.most_m = prior.radius_m or np.hypot(east_m - west_m, north_m - south_m) / 2
        self.taken = self.refused = 0

    def step(self, query: Query) -> Fix:
        """Add the odometry up, search around the estimate, and correct it by what is found."""
        self.pose, self.covariance = advance(self.pose, self.covariance, query.step)
        asked = replace(query, track="localization", prior=self.prior(query), step=None)
        found = self.matcher.match(asked, top_k=1)
        if found.poses:
            self.correct(found.poses[0])
        spread_m = np.sqrt(5.99 * np.linalg.eigvalsh(self.covariance[:2, :2])[-1])
        is_accepted = bool(self.taken >= STREAK and spread_m <= NEAR_M)
        return Fix(pose=self.pose, covariance=self.covariance, is_accepted=is_accepted)

    def prior(self, query: Query) -> Prior:
        """Three standard deviations of the belief, as the prior of a single view."""
        radius_m = 3 * np.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[-1])
        return Prior(
            center_m=(self.pose.easting_m, self.pose.northing_m),
            radius_m=float(np.clip(radius_m, LEAST_M, max(LEAST_M, self.most_m))),
            yaw_deg=self.pose.yaw_deg,
            yaw_sigma_deg=float(np.sqrt(self.covariance[2, 2])),
            scale_sigma=query.prior.scale_sigma,
        )

    def correct(self, found: Pose) -> None:
        """Take a pose that fits the belief; after many that do not, believe no more than at the start."""
        gap = np.array(
            [
                found.easting_m - self.pose.easting_m,
                found.northing_m - self.pose.northing_m,
                float(wrap_deg(found.yaw_deg - self.pose.yaw_deg)),
            ]
        )
        joint = self.covariance + FOUND
        if gap @ np.linalg.solve(joint, gap) > GATE**2:
            self.taken, self.refused = 0, self.refused + 1
            if self.refused > PATIENCE:
                self.covariance, self.refused = self.begun, 0
            return
        gain = self.covariance @ np.linalg.inv(joint)
        east_m, north_m, turn_deg = (gain @ gap).tolist()
        self.pose = Pose(
            easting_m=self.pose.easting_m + east_m,
            northing_m=self.pose.northing_m + north_m,
            yaw_deg=self.pose.yaw_deg + turn_deg,
            scale=found.scale,
        )
        left = np.eye(3) - gain
        self.covariance = left @ self.covariance @ left.T + gain @ FOUND @ gain.T
        self.taken, self.refused = self.taken + 1, 0
