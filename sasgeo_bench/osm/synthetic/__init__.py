# SPDX-License-Identifier: Apache-2.0
"""Made-up towns, written as OSM files with a history."""
