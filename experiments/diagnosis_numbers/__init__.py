"""Numbers of the diagnosis, each halved and doubled."""
