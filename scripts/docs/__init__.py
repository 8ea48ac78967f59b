"""Pictures of the documentation, made by scripts."""
