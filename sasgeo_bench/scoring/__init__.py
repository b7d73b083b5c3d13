# SPDX-License-Identifier: Apache-2.0
"""Answers and truths -> figures, how sure each is, and which differences are real."""
