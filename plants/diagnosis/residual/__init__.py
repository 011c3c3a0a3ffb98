"""What the base model leaves, and where it lives."""
