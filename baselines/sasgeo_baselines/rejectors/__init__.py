# SPDX-License-Identifier: Apache-2.0
"""Rules that estimate the probability of a false fix: one file each."""
