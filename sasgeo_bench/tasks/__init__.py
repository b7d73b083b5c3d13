# SPDX-License-Identifier: Apache-2.0
"""Tasks: splits, suites, perturbations and sampling turn regions into queries and their truths."""
