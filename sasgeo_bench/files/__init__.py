# SPDX-License-Identifier: Apache-2.0
"""Files and folders, whatever is in them: written whole or not at all, hashed, listed, removed."""
