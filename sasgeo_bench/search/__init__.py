# SPDX-License-Identifier: Apache-2.0
"""Dense pose search: three-state evidence of any weights on a map, over place, heading and scale, coarse to fine."""
