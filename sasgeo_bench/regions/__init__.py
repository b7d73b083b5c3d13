# SPDX-License-Identifier: Apache-2.0
"""Turn features into layers, network and graph: a Region, built and on disk."""
