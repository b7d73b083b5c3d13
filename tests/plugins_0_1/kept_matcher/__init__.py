# SPDX-License-Identifier: Apache-2.0
"""The package of the matcher kept-matcher."""
