# SPDX-License-Identifier: Apache-2.0

"""What a posterior over scenes is, and how samples are summarised."""
