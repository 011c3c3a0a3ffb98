"""Commands and files of somebody, or something, that writes at random."""
