# SPDX-License-Identifier: Apache-2.0
"""The nearest neighbour of a view among patches of the map, by the shares of classes in their blocks."""

import numpy as np

import sasgeo_bench as sgb

BLOCK_M, SIDE, FINE = 16.0, 8, 4  # a patch has 8 x 8 blocks of 16 m, and a block of the view 4 x 4 samples
STEP_DEG = 5.0


class PatchNeighbour:
    card = sgb.read_card(__file__)

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        step = max(1, round(BLOCK_M / region.grid.cell_size_m))
        self.grid, self.classes = region.grid.coarsen(step), region.classes
        rows, cols = (count // step for count in region.grid.shape)
        layers = (region.layer(name)[: rows * step, : cols * step] == sgb.PRESENT for name in region.classes)
        blocks = np.stack([one.reshape(rows, step, cols, step).mean((1, 3)) for one in layers])
        self.mean, self.spread = blocks.mean((1, 2), keepdims=True), np.maximum(blocks.std((1, 2), keepdims=True), 0.02)
        patches = np.lib.stride_tricks.sliding_window_view(self.scaled(blocks), (SIDE, SIDE), axis=(1, 2))
        self.patches = patches.transpose(1, 2, 0, 3, 4)

    def scaled(self, shares: np.ndarray) -> np.ndarray:
        return (shares - self.mean) / self.spread  # so that a rare class tells as much as a common one

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        rows, cols = np.indices(self.patches.shape[:2]).reshape(2, -1)
        places = self.grid.to_en_m(np.column_stack((cols, rows)) + SIDE / 2)
        prior, yaw_deg = query.prior, query.prior.yaw_deg or 0.0
        if prior.radius_m:
            near = np.hypot(*(places - prior.center_m).T) <= prior.radius_m
            places, rows, cols = places[near], rows[near], cols[near]
        if (query.evidence.cells == sgb.UNKNOWN).all() or not len(places):
            return sgb.WITHHELD
        bank = self.patches[rows, cols].reshape(len(places), -1).astype(np.float32)
        reach_deg = 180.0 if prior.yaw_deg is None else 2 * (prior.yaw_sigma_deg or 0.0)
        yaws = yaw_deg + np.arange(-reach_deg, reach_deg + 0.1, STEP_DEG)
        far = []
        for known, share in (self.patch(query.evidence, yaw) for yaw in yaws):  # what is unknown has no weight
            size = np.sqrt(bank**2 @ known * (known @ share**2))
            far.append(1 - bank @ (known * share) / np.maximum(size, 1e-6))  # of the angle between the two
        best = np.argsort(np.min(far, 0), kind="stable")[:top_k]
        turned = yaws[np.argmin(far, 0)] % 360
        poses = [sgb.Pose(easting_m=places[i][0], northing_m=places[i][1], yaw_deg=turned[i]) for i in best]
        return sgb.Match(poses=poses, scores=-np.min(far, 0)[best])

    def patch(self, seen: sgb.Evidence, yaw_deg: float) -> tuple[np.ndarray, np.ndarray]:
        """How much of each block of the view, turned north up, is known, and the share of each class in it."""
        height, width = seen.shape
        frame = sgb.Grid(epsg=32632, west_m=0, north_m=0, cell_size_m=seen.cell_size_m, rows=height, cols=width)
        (middle,) = frame.to_en_m(np.array([(width / 2, height / 2)]))
        back = sgb.Pose(easting_m=middle[0], northing_m=middle[1], yaw_deg=-yaw_deg % 360)
        cells = seen.cells[[seen.classes.index(name) for name in self.classes]]
        states = sgb.LayerBits.of(np.concatenate((cells != sgb.UNKNOWN, cells == sgb.PRESENT)).astype(np.uint8))
        found = sgb.observe(states, frame, back, size_cells=SIDE * FINE, cell_size_m=BLOCK_M / FINE) == 1
        known, present = found.reshape(2, -1, SIDE, FINE, SIDE, FINE).mean((3, 5))  # beyond the view all is unknown
        share = self.scaled(present / np.maximum(known, 1e-9))
        return known.ravel().astype(np.float32), share.ravel().astype(np.float32)
