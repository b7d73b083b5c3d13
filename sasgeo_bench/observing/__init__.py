# SPDX-License-Identifier: Apache-2.0
"""A user's own pictures: opened, located, made into tasks."""
