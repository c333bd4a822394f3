# SPDX-License-Identifier: Apache-2.0

"""The nodes, and the only imports of rclpy and message packages."""
