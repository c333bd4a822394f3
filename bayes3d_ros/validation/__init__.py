# SPDX-License-Identifier: Apache-2.0

"""How right and how fast the package is. Only the commands that need it import it."""
