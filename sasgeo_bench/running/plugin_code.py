# SPDX-License-Identifier: Apache-2.0
"""The code that answers follow from: that of a plugin, and of the tools of ours that it uses."""

from typing import Final

from sasgeo_bench.core.plugins import MATCHERS, SEGMENTERS, TRACKERS, plugin_code

# Modules of this package that answers depend on, if a plugin imports them: after a change there, it is asked anew.
TOOLS: Final = (
    *("matching.controls", "matching.follower", "osm.taxonomy", "regions.evidence", "regions.graph"),
    *("search", "sasgeo", "tasks.vectors"),
)
# The same of segmentations; segmenters look at pictures by all of them.
SEGMENTER_TOOLS: Final = ("sensing.segmentation", "sensing.image", "sensing.camera")


def matcher_code(spec: str) -> str:
    """Return the SHA-256 of the code of a matcher or tracker (`files.code_hash.plugin_code`), and of the tools it uses.

    >>> len(matcher_code("random")), matcher_code("random") == matcher_code("prior_centre")
    (64, True)
    """
    # What every query is made of
    return plugin_code(spec, MATCHERS, TRACKERS, tools=TOOLS, always=("regions.evidence",))


def segmenter_code(spec: str) -> str:
    """Return the SHA-256 of the code of a segmenter, and of all that pictures are looked at with.

    >>> len(segmenter_code("colour_thresholds"))
    64
    """
    return plugin_code(spec, SEGMENTERS, always=SEGMENTER_TOOLS)
