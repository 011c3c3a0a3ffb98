"""Speed of a sweep."""
