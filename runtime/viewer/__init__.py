"""Pages that show a scene in the browser."""
