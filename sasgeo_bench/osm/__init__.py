# SPDX-License-Identifier: Apache-2.0
"""Everything that knows OSM files: finding, cutting, reading and classifying them."""
