# SPDX-License-Identifier: Apache-2.0
"""Tasks and pictures as datasets of PyTorch; needs the extra [torch]."""
