# SPDX-License-Identifier: Apache-2.0
"""Files and folders of any content: written whole or not at all, hashed, listed, removed."""
