# SPDX-License-Identifier: Apache-2.0
"""The SASGeo paper's own experiment, Section VI: 30 procedural regions and 220 retrieval trials."""

from sasgeo_bench.experiments.paper.task import made_paper_task, make_paper_task

__all__ = ["made_paper_task", "make_paper_task"]
