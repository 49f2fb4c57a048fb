"""What the documents show: tables and images."""
