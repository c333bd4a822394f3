"""What a posterior over scenes is, and how samples are summarised."""
