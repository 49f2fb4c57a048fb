"""Many scenes: what they are, the records of what is done, and the pool of processes that does the rest."""
