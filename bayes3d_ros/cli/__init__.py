# SPDX-License-Identifier: Apache-2.0

"""The `bayes3d` command."""
