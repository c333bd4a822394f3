# SPDX-License-Identifier: Apache-2.0

"""Where a moving camera is in a known world. `session.py` is the way in."""
