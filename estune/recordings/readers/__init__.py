"""Readers: one module per family of formats, each a function from a path to a `RawFile`.

They import the library of their format when they are called.
"""
