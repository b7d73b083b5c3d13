# SPDX-License-Identifier: Apache-2.0
"""How a map grows old: pairing dated states by geometry, and the yearly rates that follow."""
