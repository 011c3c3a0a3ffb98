"""A gain schedule tuned as one thing, by trials on reels of several cable lengths.

The other way to a schedule is to tune at each length and to fit a law to what was found
(`estune.studies.law`). Here the law's own coefficients are what a tuner steps in.
"""
