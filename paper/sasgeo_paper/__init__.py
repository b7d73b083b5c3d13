# SPDX-License-Identifier: Apache-2.0
"""The SASGeo paper's own experiment, Section VI: 30 procedural regions and 220 retrieval trials.

An entry point of the group `sasgeo_bench.experiments` names this package; a pipeline file with a table `[paper]` is
drawn by it.
"""

from sasgeo_paper.board import extra
from sasgeo_paper.task import draw, drawn, made_paper_task, make_paper_task

__all__ = ["draw", "drawn", "extra", "made_paper_task", "make_paper_task"]
