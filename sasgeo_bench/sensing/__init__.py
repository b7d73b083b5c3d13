# SPDX-License-Identifier: Apache-2.0
"""From the ground to the picture and back: cameras, images, segmentation, bird's-eye views."""
