# SPDX-License-Identifier: Apache-2.0

"""Speed, and what it is compared with."""
