# SPDX-License-Identifier: Apache-2.0
"""Perturbations, one file each: evidence in, harder evidence out."""
