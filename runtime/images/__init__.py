"""Images and videos: reading, checking, resizing and writing."""
