# SPDX-License-Identifier: Apache-2.0

"""Small files that others may have written or damaged, and files that are replaced whole or not at all."""
