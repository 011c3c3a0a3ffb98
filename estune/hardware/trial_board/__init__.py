"""A board that closes the loop itself: gains and profile in, record back, by a serial port.

`estune_trial_board.c` is its program, `export.board_files` writes it with the rig's own limits,
`rig.BoardRig` is the rig on the computer. For every bus too slow to close the loop over it.
"""
