"""Structure from motion: features, matches and camera poses from images alone."""
