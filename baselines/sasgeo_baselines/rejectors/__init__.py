# SPDX-License-Identifier: Apache-2.0
"""Rules that say of an answer how likely it is a false fix: one file for each."""
