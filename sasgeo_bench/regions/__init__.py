# SPDX-License-Identifier: Apache-2.0
"""Features -> layers, network, graph: a Region, built and on disk."""
