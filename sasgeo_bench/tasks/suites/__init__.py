# SPDX-License-Identifier: Apache-2.0
"""The suites: one file each; region + sites + seed -> queries and truths."""
