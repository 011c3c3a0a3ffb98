"""What a diagnosis says, and how it is shown."""
