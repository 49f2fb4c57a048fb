"""One module a splat format, and what the formats share."""
