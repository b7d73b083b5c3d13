# SPDX-License-Identifier: Apache-2.0
"""The package of the tracker kept-tracker."""
