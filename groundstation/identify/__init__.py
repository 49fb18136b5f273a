"""Which physical effects are missing: fits, searches and what remains unexplained."""
