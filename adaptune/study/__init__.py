"""A study: what to tune and on which sequences, and the folder that keeps its results."""
