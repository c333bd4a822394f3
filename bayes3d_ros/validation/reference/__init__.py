# SPDX-License-Identifier: Apache-2.0

"""Problems small enough for exact answers, and the exact answers."""
