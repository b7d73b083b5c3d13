# SPDX-License-Identifier: Apache-2.0
"""Pipeline files -> boards; the paper's own experiment."""
