"""The live page: rigs, runs and daemons in a browser.

A `Board` holds what a page shows. Readers keep it up to date: of a run's journal, of a rig, of a
daemon. `PageServer` sends each page what has changed on its board. Nothing here can slow or stop a
run: a journal is read through a read-only connection, samples arrive through a ring buffer that
drops the oldest, and a slow page is sent the newest values alone.
"""
