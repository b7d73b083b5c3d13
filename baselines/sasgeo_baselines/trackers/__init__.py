# SPDX-License-Identifier: Apache-2.0
"""Trackers: methods that follow a flight."""
