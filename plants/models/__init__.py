"""Plant models: reels, linear systems, Python functions, model files."""
