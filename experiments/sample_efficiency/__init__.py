"""How few trials, and how few dangerous ones, does each tuner need under measurement noise?"""
