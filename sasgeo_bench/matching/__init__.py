# SPDX-License-Identifier: Apache-2.0
"""The doors that plugins come in by, and what passes through them."""
