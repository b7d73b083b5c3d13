# SPDX-License-Identifier: Apache-2.0
"""Dense search over place, heading and scale: by sums of likelihoods (`find`) or by mean votes (`vote_search`)."""
