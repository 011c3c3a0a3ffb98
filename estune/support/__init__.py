"""Plumbing without knowledge of control: SQLite, C compiler, TOML files, drawing, HTML."""
