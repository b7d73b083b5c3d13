# SPDX-License-Identifier: Apache-2.0
"""Rows of `part-*.parquet`: their schema, and predictions to and from it."""

from collections.abc import Mapping
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.pose import Pose
from sasgeo_bench.region import ATTRIBUTION, LICENCE
from sasgeo_bench.results import Prediction
from sasgeo_bench.store.taskrows import ASKED, POSE_FIELDS, is_like

SCHEMA_VERSION: Final = 1
_CANDIDATE: Final = pa.struct([(name, pa.float64()) for name in (*POSE_FIELDS, "score")])
PREDICTION_SCHEMA: Final = pa.schema(
    [
        ("query_id", pa.string()),
        ("candidates", pa.list_(_CANDIDATE)),
        ("confidence", pa.float64()),
        ("diagnostics", pa.map_(pa.string(), pa.float64())),
        ("status", pa.string()),
        ("message", pa.string()),
        ("latency_s", pa.float64()),
    ],
    metadata={"schema_version": str(SCHEMA_VERSION), "attribution": ATTRIBUTION, "licence": LICENCE},
)
RUN_SCHEMA: Final = PREDICTION_SCHEMA.append(pa.field(ASKED, pa.string()))  # of a run's own parts


def prediction_row(prediction: Prediction) -> dict[str, Any]:
    """One prediction as a row of `PREDICTION_SCHEMA`."""
    return {
        "query_id": prediction.query_id,
        "candidates": [
            {
                "easting_m": pose.easting_m,
                "northing_m": pose.northing_m,
                "yaw_deg": pose.yaw_deg,
                "scale": pose.scale,
                "score": score,
            }
            for pose, score in prediction.candidates
        ],
        "confidence": prediction.confidence,
        "diagnostics": list(prediction.diagnostics.items()),
        "status": prediction.status,
        "message": prediction.message,
        "latency_s": prediction.latency_s,
    }


def prediction_of(row: Mapping[str, Any]) -> Prediction:
    """Inverse of `prediction_row`; whatever else a candidate holds is passed over."""
    poses = tuple(
        (Pose(**{name: item[name] for name in POSE_FIELDS}), item["score"]) for item in row["candidates"] or ()
    )
    return with_candidates(row, poses)


def with_candidates(row: Mapping[str, Any], candidates: tuple[tuple[Pose, float], ...]) -> Prediction:
    """Make a prediction of a row whose candidates were read by columns."""
    return Prediction(
        query_id=row["query_id"],
        candidates=candidates,
        confidence=row["confidence"],
        diagnostics=dict(row["diagnostics"] or ()),
        status=row["status"],
        message=row["message"] or "",
        latency_s=row["latency_s"],
    )


def differing_columns(table: pa.Table) -> list[tuple[str, str, str]]:
    """Columns that a table of predictions must hold and this one does not: their names, what is found, and expected.

    More columns, in any order, do no harm.

    Examples
    --------
    >>> differing_columns(PREDICTION_SCHEMA.empty_table().drop_columns(["message"]))
    [('message', 'nothing', 'string')]
    """
    found = {field.name: field.type for field in table.schema}
    counts = {field: table.schema.names.count(field.name) for field in PREDICTION_SCHEMA}
    twice = [(field.name, f"{count} columns", str(field.type)) for field, count in counts.items() if count > 1]
    return twice or [
        (field.name, str(found.get(field.name, "nothing")), str(field.type))
        for field in PREDICTION_SCHEMA
        if field.name not in found or not is_like(found[field.name], field.type)
    ]
