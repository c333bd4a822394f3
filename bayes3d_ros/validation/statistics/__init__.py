"""What is computed from samples and truths: ranks, regions, errors, agreement."""
