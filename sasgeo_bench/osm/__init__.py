# SPDX-License-Identifier: Apache-2.0
"""Find, cut, read and classify OSM files."""
