# SPDX-License-Identifier: Apache-2.0
"""Flights: where a drone was, and what its odometry says of it, with drift as it was measured."""
