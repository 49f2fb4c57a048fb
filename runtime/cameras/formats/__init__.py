"""One module a camera format."""
