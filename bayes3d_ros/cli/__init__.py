"""The `bayes3d` command."""
