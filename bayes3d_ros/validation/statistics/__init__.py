# SPDX-License-Identifier: Apache-2.0

"""What is computed from samples and truths: ranks, regions, errors, agreement."""
