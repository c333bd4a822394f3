"""How the posterior is found."""
