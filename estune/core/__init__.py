"""The pure part: no input or output, no clock, no random numbers, no logging.

Everything here is a function of its arguments, so that a run can be replayed exactly.
"""
