"""Images brought together with their cameras, and the selection among them."""
