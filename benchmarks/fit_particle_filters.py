# SPDX-License-Identifier: Apache-2.0
"""Fit what the particle filters of the baselines ship, on made-up towns that are in no split.

    python benchmarks/fit_particle_filters.py --out out/particle-filters [--write]

draws six towns from a seed that no region of ours has, flies over them (suite `flight-clean`), and fits the embedding
of `zhou_smc` and the ratio of `kinnari_mcl`. `--write` replaces the file of the embedding, whose hash belongs into the
tracker. `--floors` flies `ouyang_cfbvm_pf` with several floors of its likelihood instead.
"""

import argparse
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sasgeo_baselines import polar
from sasgeo_baselines.trackers import kinnari_mcl, zhou_smc
from sasgeo_baselines.trackers.ouyang_cfbvm_pf import OuyangCfbvmPf
from sasgeo_baselines.trackers.particles import NEAR_M, Particles
from sklearn.linear_model import LogisticRegression

import sasgeo_bench as sgb

MORPHOLOGIES = ("agricultural", "grid", "industrial", "old_town", "riverside", "suburb")
SEED, SIZE_M, FLIGHTS = 4711, 2048.0, 4
KINDS = ("no drift", "no drift again")  # the other variants of a flight show the same views
DRIFTING = "F1 vo-mono-survey"
EVERY = 3  # views for the ratio of kinnari_mcl: neighbours are alike
RIGHTS, RIGHT_M, RIGHT_DEG = 20, 8.0, 2.0  # particles about the truth
WRONGS, WRONGS_M, WRONG_DEG, APART_M = 40, (60.0, 500.0), 20.0, 16.0
FLOORS = (1.0, 0.3, 0.1, 0.03, 0.01)
PRINCIPAL = 96  # components kept before the canonical correlation
RIDGE = 0.05  # of the mean variance of these components

Floats = NDArray[np.float32]

REGION = """\
id = "{name}"
title = "Town to fit particle filters on"
scenes = ["urban"]
center_lonlat = [{lon}, 50.0]
size_m = [{size_m:.0f}, {size_m:.0f}]
cell_size_m = 1.0

[[extract]]
file = "{name}-2025-01-01.osm.pbf"
date = 2025-01-01
town = {{ morphology = "{morphology}", seed = {seed}, size_m = {size_m} }}
"""
SPLIT = """\
id = "fit-particle-filters"
title = "Towns to fit particle filters on"
kind = "crossfit"
buffer_m = 5000.0
block_m = 1000.0
reach_m = 360.0
"""
PLACE = '\n[[place]]\nname = "{name}"\nhalf = "{half}"\nregions = ["{name}"]\n'


@dataclass(frozen=True, kw_only=True)
class View:
    """A view of a flight with errors of perception, and where it was taken."""

    query: sgb.Query
    pose: sgb.Pose


@dataclass(frozen=True, kw_only=True)
class Town:
    """A made-up town and the views of flights over it."""

    region: sgb.Region
    views: tuple[View, ...]


def draw_towns(out: Path) -> list[Town]:
    """Build the towns and draw the flights."""
    names = {f"fit-{morphology.replace('_', '-')}": morphology for morphology in MORPHOLOGIES}
    folder, split = out / "region-files", out / "fit-particle-filters.toml"
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, morphology) in enumerate(names.items()):
        text = REGION.format(name=name, morphology=morphology, lon=8.0 + number / 2, size_m=SIZE_M, seed=SEED)
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    places = [PLACE.format(name=name, half="ab"[number % 2]) for number, name in enumerate(names)]
    split.write_text("".join([SPLIT, *places]), encoding="utf-8")
    sgb.make_tasks(
        suite=["flight-clean"],
        regions=list(names),
        split=str(split),
        n=FLIGHTS,
        region_files=[folder],
        out=out,
        up_to=True,
    )
    return [Town(region=sgb.read_region(out / "regions" / name), views=tuple(read_views(out, name))) for name in names]


def read_views(out: Path, name: str, *, kinds: tuple[str, ...] = KINDS) -> Iterator[View]:
    """Yield the views of a town with their poses, in the order of flights."""
    truths = {truth.query_id: truth for truth in sgb.read_truths(out / "truth" / "flight-clean" / name)}
    for query in sgb.read_queries(out / "tasks" / "flight-clean" / name):
        truth = truths[query.query_id]
        if truth.kind in kinds and truth.pose is not None:
            yield View(query=query, pose=truth.pose)


def map_descriptors(town: Town) -> Floats:
    """Descriptors of the map at the poses of the views, as the table of the tracker reads them."""
    stride = round(zhou_smc.STEP_M / polar.CELL_M)
    rows = np.stack(list(polar.described(town.region, stride=stride)))
    west_m, _, _, north_m = town.region.grid.bounds_m
    return np.stack([_between(rows, view.pose, west_m, north_m) for view in town.views])


def _between(rows: Floats, pose: sgb.Pose, west_m: float, north_m: float) -> Floats:
    """Interpolate between four places and two headings."""
    down, right = (north_m - pose.northing_m) / zhou_smc.STEP_M, (pose.easting_m - west_m) / zhou_smc.STEP_M
    (row, col), (below, beyond) = (int(down), int(right)), (down % 1, right % 1)
    north_up = (1 - below) * ((1 - beyond) * rows[row, col] + beyond * rows[row, col + 1]) + below * (
        (1 - beyond) * rows[row + 1, col] + beyond * rows[row + 1, col + 1]
    )
    turn, past = divmod(pose.yaw_deg * zhou_smc.YAWS / 360.0, 1.0)
    first, second = (polar.turned(north_up, -int(turn) - more, yaws=zhou_smc.YAWS) for more in (0, 1))
    return np.asarray((1 - past) * first + past * second, dtype=np.float32)


def fit_embedding(towns: list[Town]) -> zhou_smc.Embedding:
    """Fit the two linear maps: principal components of either side, then canonical correlation.

    Pairs are turned together by the headings of the table, so that no heading is preferred.
    """
    seen = all_turns(np.stack([polar.view_descriptor(view.query.evidence) for town in towns for view in town.views]))
    mapped = all_turns(np.concatenate([map_descriptors(town) for town in towns]))
    seen_mean, mapped_mean = np.nanmean(seen, axis=0), mapped.mean(axis=0)
    seen, mapped = np.where(np.isnan(seen), 0, seen - seen_mean), mapped - mapped_mean
    left, right = whitening(seen), whitening(mapped)
    first, strength, second = np.linalg.svd((seen @ left).T @ (mapped @ right) / len(seen))
    print(f"{len(seen) // zhou_smc.YAWS} views; canonical correlations {strength[: zhou_smc.DIMENSIONS].round(2)}")
    by = np.sqrt(strength[: zhou_smc.DIMENSIONS])
    return zhou_smc.Embedding(
        view=(left @ first[:, : zhou_smc.DIMENSIONS] * by).astype(np.float32),
        view_mean=seen_mean.astype(np.float32),
        mapped=(right @ second[: zhou_smc.DIMENSIONS].T * by).astype(np.float32),
        mapped_mean=mapped_mean.astype(np.float32),
    )


def all_turns(descriptors: Floats) -> Floats:
    """Return descriptors, shape (N, D), at all headings of the table, shape (N * YAWS, D)."""
    turns = [polar.turned(descriptors.T, turn, yaws=zhou_smc.YAWS).T for turn in range(zhou_smc.YAWS)]
    return np.concatenate(turns)


def whitening(centred: Floats) -> Floats:
    """Return the principal components of descriptors, shape (D, PRINCIPAL), each divided by its standard deviation."""
    values, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
    values, vectors = values[::-1][:PRINCIPAL], vectors[:, ::-1][:, :PRINCIPAL]
    return np.asarray(vectors / np.sqrt(values + RIDGE * values.mean()))


def write_embedding(embedding: zhou_smc.Embedding, path: Path) -> str:
    """Write an embedding in half precision, the same bytes for the same numbers; return its hash."""
    arrays = {item.name: getattr(embedding, item.name).astype(np.float16) for item in fields(embedding)}
    np.savez(path, groups=np.array(zhou_smc.group_names()), **arrays)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def fit_ratio(towns: list[Town], *, rng: np.random.Generator) -> Floats:
    """Fit the log-likelihood ratio of `kinnari_mcl`: particles about the truth against others of a disc around it."""
    rows, labels = [], []
    for town in towns:
        mosaic = kinnari_mcl.Mosaic.of(town.region)
        for view in town.views[::EVERY]:
            near = around(view.pose, reach_m=RIGHT_M, yaw_deg=RIGHT_DEG, count=RIGHTS, rng=rng)
            chosen = [(near, 1)]
            for reach_m in WRONGS_M:
                far = around(view.pose, reach_m=reach_m, yaw_deg=WRONG_DEG, count=WRONGS, rng=rng)
                is_far = sgb.offsets_m(far.place_m, (view.pose.easting_m, view.pose.northing_m)) > APART_M
                chosen.append((far.within(is_far), 0))
            template = kinnari_mcl.Template.of(view.query.evidence)
            for particles, label in chosen:
                rows.append(kinnari_mcl.features(kinnari_mcl.surfaces(template, mosaic, particles)))
                labels += [label] * len(particles)
    fitted = LogisticRegression(class_weight="balanced", fit_intercept=False, C=1e3).fit(np.concatenate(rows), labels)
    print(f"{len(labels)} places; ratio {fitted.coef_[0].round(2).tolist()}")
    return np.asarray(fitted.coef_[0])


def around(pose: sgb.Pose, *, reach_m: float, yaw_deg: float, count: int, rng: np.random.Generator) -> Particles:
    """Draw particles evenly over a disc around a pose, with normal headings."""
    prior = sgb.Prior(
        center_m=(pose.easting_m, pose.northing_m),
        radius_m=reach_m,
        yaw_deg=pose.yaw_deg,
        yaw_sigma_deg=yaw_deg,
        scale_sigma=0.03,
    )
    grid = sgb.Grid.around(*prior.center_m, size_m=(1.0, 1.0), cell_size_m=1.0, epsg=32632)
    return Particles.drawn(prior, grid, count=count, rng=rng)


def try_floors(out: Path, towns: list[Town]) -> None:
    """Fly the tracker of Ouyang over the towns with several floors; print what lies within 25 m, and what is wrong."""
    for floor in FLOORS:
        tracker, far_m, accepted = OuyangCfbvmPf(floor=floor), [], []
        for town in towns:
            tracker.prepare(town.region, None)
            for view in read_views(out, town.region.manifest.id, kinds=(DRIFTING,)):
                if view.query.step is not None and view.query.step.frame == 0:
                    tracker.start(view.query.prior)
                fix = tracker.step(view.query)
                pose = view.pose if fix.pose is None else fix.pose
                far_m.append(np.hypot(pose.easting_m - view.pose.easting_m, pose.northing_m - view.pose.northing_m))
                accepted.append(fix.is_accepted)
        is_far, is_accepted = np.array(far_m) > NEAR_M, np.array(accepted)
        print(
            f"floor {floor:g}: {len(is_far)} views, within {NEAR_M:g} m {1 - is_far.mean():.2f}, accepted "
            f"{is_accepted.mean():.2f}, of these wrong {is_far[is_accepted].mean():.2f}"
        )


def main() -> None:
    """Fit, and say what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/particle-filters"), help="folder of the towns")
    parser.add_argument("--write", action="store_true", help="replace the file of the baselines")
    parser.add_argument("--floors", action="store_true", help="try floors of ouyang_cfbvm_pf, and fit nothing")
    options = parser.parse_args()
    towns = draw_towns(options.out)
    if options.floors:
        try_floors(options.out, towns)
        return
    fit_ratio(towns, rng=np.random.default_rng(SEED))
    path = zhou_smc.EMBEDDING if options.write else options.out / zhou_smc.EMBEDDING.name
    print(f"{path}: SHA-256 {write_embedding(fit_embedding(towns), path)}")


if __name__ == "__main__":
    main()
