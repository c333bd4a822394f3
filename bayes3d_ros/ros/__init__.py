"""The nodes, and the only imports of rclpy and message packages."""
