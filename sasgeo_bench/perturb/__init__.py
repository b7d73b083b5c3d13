# SPDX-License-Identifier: Apache-2.0
"""What makes a view harder: one file per perturbation, evidence in, harder evidence out."""
