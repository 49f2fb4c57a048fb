"""What the documents show: tables and pictures."""
