# SPDX-License-Identifier: Apache-2.0
"""The template of OrienterNet without its network: a view, turned to each heading, is correlated with the map.

Sarlin et al., "OrienterNet", CVPR 2023, Section 3.3: the score of a pose is the correlation of the bird's-eye view,
turned to its heading, with the map around its place; all places at once in the Fourier domain; the prior is added to
the scores. Where the paper has features of a network there are shares of classes here, less their mean on the map and
in their standard deviations, and the correlation is normalized by what of the map lies under the view (Lewis, "Fast
normalized cross-correlation", 1995).
"""

import numpy as np

import sasgeo_bench as sgb

CELL_M = 4.0
STEP_DEG = 4.0
TEMPERATURE = 0.02  # of a correlation, against the logarithm of the prior: a guess
APART_M = 25.0  # two answers are no nearer to each other
LEAST_STD = 0.02  # of a class that the map hardly has


class PlainTemplate:
    """Normalized correlation of class shares over places and headings."""

    card = sgb.read_card(__file__)

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Keep the shares of all classes in cells of 4 m."""
        step = max(1, round(CELL_M / region.grid.cell_size_m))
        rows, cols = (count // step for count in region.grid.shape)
        self.grid, self.classes = region.grid.coarsen(step), region.classes
        layers = (region.layer(name)[: rows * step, : cols * step] == sgb.PRESENT for name in region.classes)
        shares = np.stack([one.reshape(rows, step, cols, step).mean((1, 3)) for one in layers])
        self.mean = shares.mean((1, 2), keepdims=True)
        self.std = np.maximum(shares.std((1, 2), keepdims=True), LEAST_STD)
        self.map = ((shares - self.mean) / self.std).astype(np.float32)

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Score every place of the disc, or of the map, at every heading of the prior; or the candidates alone."""
        if (query.evidence.cells == sgb.UNKNOWN).all():
            return sgb.WITHHELD
        prior = query.prior
        middle = prior.yaw_deg or 0.0
        reach_deg = 180.0 if prior.yaw_deg is None else 2 * (prior.yaw_sigma_deg or 0.0)
        turns = np.arange(-reach_deg, reach_deg + 0.1, STEP_DEG) if not query.candidates else np.zeros(1)
        row, col, window = self.window(query)
        shape = tuple(fast(count + self.side(query.evidence)) for count in window.shape[1:])
        spectrum, energy = np.fft.rfft2(window, shape), np.fft.rfft2((window**2).sum(0, keepdims=True), shape)
        volume = []
        for turn in turns:
            template, known = self.template(query.evidence, middle + turn)
            under = np.maximum(correlate(energy, known, shape), 1e-6)
            scores = correlate(spectrum, template, shape) / np.sqrt(under * max(float((template**2).sum()), 1e-6))
            scores = scores[: window.shape[1], : window.shape[2]]
            if prior.yaw_deg is not None and prior.yaw_sigma_deg:
                scores -= TEMPERATURE * 0.5 * (turn / prior.yaw_sigma_deg) ** 2
            volume.append(scores)
        best, turned = np.max(volume, 0), np.argmax(volume, 0)
        rows, cols = np.indices(best.shape)
        places = self.grid.to_en_m(np.column_stack((cols.ravel() + col, rows.ravel() + row)) + 0.5)
        if query.candidates:
            at = self.grid.to_cells(np.array([(one.easting_m, one.northing_m) for one in query.candidates]))
            scores = best[tuple(np.clip(at - (row, col), 0, np.subtract(best.shape, 1)).T)]
            order = np.argsort(-scores, kind="stable")[:top_k]
            return sgb.Match(poses=[query.candidates[i] for i in order], scores=scores[order])
        left = best.ravel().astype(np.float64)
        if prior.center_m is not None and prior.radius_m is not None:
            left[np.hypot(*(places - prior.center_m).T) > prior.radius_m] = -np.inf
        poses, scores = [], []
        while len(poses) < top_k and np.isfinite(left.max()):
            i = int(np.argmax(left))
            yaw_deg = (middle + turns[turned.ravel()[i]]) % 360
            poses.append(sgb.Pose(easting_m=places[i, 0], northing_m=places[i, 1], yaw_deg=yaw_deg))
            scores.append(left[i])
            left[np.hypot(*(places - places[i]).T) < APART_M] = -np.inf
        return sgb.Match(poses=poses, scores=scores) if poses else sgb.WITHHELD

    def window(self, query: sgb.Query) -> tuple[int, int, np.ndarray]:
        """Cut the map to the disc of the prior; return the first row and column, and the window."""
        prior, (_, rows, cols) = query.prior, self.map.shape
        if query.candidates or prior.center_m is None or prior.radius_m is None:
            return 0, 0, self.map
        ((row, col),) = self.grid.to_cells(np.array([prior.center_m]))
        reach = int(np.ceil((prior.radius_m + max(query.evidence.size_m)) / self.grid.cell_size_m))
        top, left = np.clip(row - reach, 0, rows - 1), np.clip(col - reach, 0, cols - 1)
        return int(top), int(left), self.map[:, top : max(row + reach, top + 1), left : max(col + reach, left + 1)]

    def side(self, seen: sgb.Evidence) -> int:
        """Return the side of a square that holds the view at any heading, an odd number of cells of the map."""
        return int(np.hypot(*seen.size_m) / self.grid.cell_size_m) // 2 * 2 + 1

    def template(self, seen: sgb.Evidence, yaw_deg: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the view, north up, in cells of the map (class, row, col), and what of each cell is known."""
        cell_m, side, (height, width) = self.grid.cell_size_m, self.side(seen), seen.shape
        fine = max(1, round(cell_m / 2.0))  # samples a side of each cell, so that thin roads are not lost
        steps = (np.arange(side * fine) + 0.5 - side * fine / 2) * cell_m / fine
        (east, north), yaw = np.meshgrid(steps, -steps), np.radians(yaw_deg)
        col = np.floor(width / 2 + (east * np.cos(yaw) - north * np.sin(yaw)) / seen.cell_size_m).astype(int)
        row = np.floor(height / 2 - (east * np.sin(yaw) + north * np.cos(yaw)) / seen.cell_size_m).astype(int)
        is_inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        cells = seen.cells[[seen.classes.index(name) for name in self.classes]]
        cells = np.where(is_inside, cells[:, row.clip(0, height - 1), col.clip(0, width - 1)], sgb.UNKNOWN)
        blocks = cells.reshape(-1, side, fine, side, fine)
        known, present = (blocks != sgb.UNKNOWN).mean((2, 4)), (blocks == sgb.PRESENT).mean((2, 4))
        share = present / np.maximum(known, 1e-6)
        return (known * (share - self.mean) / self.std).astype(np.float32), known.mean(
            0, keepdims=True, dtype=np.float32
        )


def correlate(spectrum: np.ndarray, template: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the correlation, summed over classes, for the middle of the template on each cell of the padded map."""
    side = template.shape[-1] // 2
    found = np.fft.irfft2((spectrum * np.conj(np.fft.rfft2(template, shape))).sum(0), shape)
    return np.roll(found, (side, side), axis=(0, 1))


def fast(count: int) -> int:
    """Return the next length that is quick to transform: a product of twos, threes and fives."""
    lengths = sorted(2**a * 3**b * 5**c for a in range(14) for b in range(9) for c in range(6))
    return next(length for length in lengths if length >= count)
