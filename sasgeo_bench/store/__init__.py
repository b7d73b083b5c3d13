# SPDX-License-Identifier: Apache-2.0
"""Reading and writing the nouns: with `extract` the only code that opens files."""
