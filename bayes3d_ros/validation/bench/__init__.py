"""Speed, and what it is compared with."""
