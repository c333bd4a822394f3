# SPDX-License-Identifier: Apache-2.0

"""Neural networks that experiments compare with, on JAX: Equinox and Optax (extra: experiments)."""
