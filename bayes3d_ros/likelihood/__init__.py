# SPDX-License-Identifier: Apache-2.0

"""How likely a depth image is, given a scene: the scored image, renderers, densities, kernels that do both at once."""
