# SPDX-License-Identifier: Apache-2.0

"""Sequential Monte Carlo in general: nothing here knows what an object is."""
