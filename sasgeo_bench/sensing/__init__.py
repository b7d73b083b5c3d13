# SPDX-License-Identifier: Apache-2.0
"""From the map to the air and back: cameras, aerial images, what is seen in them, and the view from above it gives."""
