# SPDX-License-Identifier: Apache-2.0

"""From one depth frame to a posterior over scenes. `parser.py` is the way in."""
