# SPDX-License-Identifier: Apache-2.0
"""Score answers against truths: metrics, confidence intervals, and tests of differences."""
