"""Results of a run: what it found, as values, words, figures, a page and files."""
